/** Contacts of feet with the ground, detected as the server detects them: by speed, with a majority filter. */
import type { Clip } from "./clip";
import { Kinematics } from "./kinematics";

/** Greatest speed of a standing foot, in metres per second. */
const SPEED_LIMIT = 0.15;
/** Duration of the majority filter, in seconds. */
const WINDOW = 0.1;

/** Return, for each foot of the skeleton, one byte per frame: 1 where the foot touches the ground. */
export function findContacts(clip: Clip): Uint8Array[] {
  const kinematics = new Kinematics(clip);
  const { feet } = clip.skeleton;
  const places = feet.map(() => new Float64Array(3 * clip.frames));
  for (let frame = 0; frame < clip.frames; frame++) {
    const positions = kinematics.update(frame);
    feet.forEach((foot, index) => places[index]!.set(positions.subarray(3 * foot, 3 * foot + 3), 3 * frame));
  }
  const reach = Math.max(0, Math.floor((Math.floor(WINDOW * clip.frameRate + 1e-9) - 1) / 2));
  return places.map((path) => majority(slowFrames(path, clip), reach));
}

/** Return for each frame whether the speed is below the limit: central differences, extrapolated at both ends. */
function slowFrames(path: Float64Array, clip: Clip): Uint8Array {
  const last = clip.frames - 1;
  const step = (frame: number, axis: number) => path[3 * (frame + 1) + axis]! - path[3 * frame + axis]!;
  const velocity = (frame: number, axis: number) => {
    if (last < 2) return last === 1 ? step(0, axis) : 0;
    if (frame === 0) return 1.5 * step(0, axis) - 0.5 * step(1, axis);
    if (frame === last) return 1.5 * step(last - 1, axis) - 0.5 * step(last - 2, axis);
    return 0.5 * (step(frame - 1, axis) + step(frame, axis));
  };
  return Uint8Array.from({ length: clip.frames }, (_, frame) => {
    const distance = Math.hypot(velocity(frame, 0), velocity(frame, 1), velocity(frame, 2));
    return distance * clip.frameRate < SPEED_LIMIT ? 1 : 0;
  });
}

function majority(flags: Uint8Array, reach: number): Uint8Array {
  const last = flags.length - 1;
  return flags.map((_, frame) => {
    let votes = 0;
    for (let shift = -reach; shift <= reach; shift++) votes += flags[Math.min(Math.max(frame + shift, 0), last)]!;
    return 2 * votes > 2 * reach + 1 ? 1 : 0;
  });
}
