/** Prints the time of forward kinematics for 100 skeletons of 63 joints (`npm run times`); the goal is 2 ms. */
import { bench } from "vitest";
import { Clip } from "../src/motion/clip";
import { Kinematics } from "../src/motion/kinematics";
import { Skeleton } from "../src/motion/skeleton";

const JOINTS = 63;
const SKELETONS = 100;
const FRAMES = 60;

/** A body of six chains that begin at the root, with rotations that differ from frame to frame. */
function crowd(): Kinematics[] {
  const joints = Array.from({ length: JOINTS }, (_, number) => ({
    name: `joint ${number}`, parent: number === 0 ? -1 : Math.max(number - 6, 0), offset: [0.02, 0.1, 0.01] as [number, number, number],
  }));
  const skeleton = new Skeleton({ joints });
  const width = 3 + 4 * JOINTS;
  const poses = new Float32Array(FRAMES * width);
  for (let at = 0; at < poses.length; at++) poses[at] = at % width < 3 ? 0 : Math.sin(at) / 2;
  const clip = new Clip("crowd", skeleton, 30, skeleton.names, poses);
  return Array.from({ length: SKELETONS }, () => new Kinematics(clip));
}

const bodies = crowd();
let frame = 0;

bench(`one pose of ${SKELETONS} skeletons of ${JOINTS} joints`, () => {
  frame = (frame + 1) % FRAMES;
  for (const body of bodies) body.update(frame);
});
