/** Shape of a mannequin for any skeleton, derived from the lengths of its bones alone; no drawn asset is needed. */
import { Clip } from "../motion/clip";
import { Kinematics } from "../motion/kinematics";
import type { Skeleton } from "../motion/skeleton";

/** Part of a body between a point and its parent. */
export interface Limb {
  from: number;
  to: number;
  radius: number;
}

/** Ball halfway between two points. */
export interface Ball {
  from: number;
  to: number;
  radius: number;
}

export interface Body {
  /** All bones that have a length. */
  bones: Limb[];
  /** The limbs of a mannequin, which has a ball in place of the bone of the head. */
  limbs: Limb[];
  balls: Ball[];
  /** Height of the body at rest, in metres. */
  height: number;
  /** Joints between which the body is in the middle of a picture: the hips, and the head of a body that walks on four legs. */
  middle: number[];
}

const SHORTEST_LIMB = 1e-3;
/** Radius of a limb that carries one metre of bones; limbs that carry more are thicker, like the branches of a tree. */
const RADIUS_OF_A_METRE = 0.054;
const STANDARD_HEIGHT = 1.75;

/** Return the shape of a mannequin with the bones of a skeleton. */
export function shapeBody(skeleton: Skeleton): Body {
  const rest = restPositions(skeleton);
  const carriers = skeleton.carriers();
  const heights = Array.from({ length: skeleton.pointCount }, (_, point) => rest[3 * point + 1]!);
  const ofBody = rest.filter((_, at) => !carriers.has(Math.floor(at / 3)));
  const spread = [0, 1, 2].map((axis) => extent(ofBody, axis));
  const height = uprightHeight(skeleton) ?? Math.max(spread[1]!, 0.5 * Math.max(...spread), 1e-3);
  const scale = height / STANDARD_HEIGHT;
  const carried = skeleton.subtreeLengths();
  const top = skeleton.head >= 0 ? skeleton.head : heights.indexOf(Math.max(...heights));
  const crown = skeleton.parents.findIndex((parent, point) => parent === top && skeleton.boneLength(point) > 0.02 * scale);
  const bones: Limb[] = [];
  for (let point = 1; point < skeleton.pointCount; point++) {
    const length = skeleton.boneLength(point);
    if (length < SHORTEST_LIMB * scale || point === skeleton.hips || carriers.has(point)) continue;
    const isTrunk = skeleton.sides[point] === "centre" && carried[point]! > 1.2 * scale;
    const thickness = RADIUS_OF_A_METRE * Math.sqrt(carried[point]! / scale) * scale;
    const radius = isTrunk ? 0.1 * scale : Math.min(thickness, 0.075 * scale, 0.42 * length + 0.01 * scale);
    bones.push({ from: skeleton.parents[point]!, to: point, radius: Math.max(radius, 0.007 * scale) });
  }
  const limbs = bones.filter((bone) => bone.to !== crown);
  const balls: Ball[] = limbs
    .filter((limb) => limb.to < skeleton.jointCount)
    .map((limb) => ({ from: limb.to, to: limb.to, radius: 0.82 * limb.radius }));
  for (const hub of hubs(skeleton)) balls.push({ from: hub, to: hub, radius: 0.11 * scale });
  balls.push({ from: top, to: crown < 0 ? top : crown, radius: 0.105 * scale });
  const isLong = ahead(rest, skeleton.hips, top) > Math.abs(rest[3 * top + 1]! - rest[3 * skeleton.hips + 1]!);
  return { bones, limbs, balls, height, middle: isLong ? [skeleton.hips, top] : [skeleton.hips] };
}

/** Length of the bones from a foot to the head; undefined if feet or head are unknown.
 *
 * The pose at rest need not stand: in some files, all its bones lie along one axis.
 */
function uprightHeight(skeleton: Skeleton): number | undefined {
  const { feet, head, parents } = skeleton;
  if (feet.length === 0 || head <= 0) return undefined;
  const ofTrunk = new Map<number, number>(); // lengths from the head to each joint above it
  for (let [joint, length] = [head, 0]; joint >= 0; joint = parents[joint]!) {
    ofTrunk.set(joint, length);
    length += skeleton.boneLength(joint);
  }
  const lengths = feet.map((foot) => {
    let length = 0;
    let joint = foot;
    for (; !ofTrunk.has(joint); joint = parents[joint]!) length += skeleton.boneLength(joint);
    return length + ofTrunk.get(joint)!;
  });
  return Math.max(...lengths);
}

/** Joints from which at least three bones branch off: pelvis and chest. */
function hubs(skeleton: Skeleton): number[] {
  const carried = skeleton.subtreeLengths();
  const total = carried[0]!;
  const branches = new Map<number, number>();
  skeleton.parents.forEach((parent, point) => {
    if (carried[point]! > 0.06 * total) branches.set(parent, (branches.get(parent) ?? 0) + 1);
  });
  return [...branches].filter(([joint, count]) => joint >= 0 && count >= 3).map(([joint]) => joint);
}

/** Horizontal distance of two points. */
function ahead(positions: Float64Array, one: number, other: number): number {
  return Math.hypot(positions[3 * one]! - positions[3 * other]!, positions[3 * one + 2]! - positions[3 * other + 2]!);
}

function restPositions(skeleton: Skeleton): Float64Array {
  const poses = Float32Array.from([...skeleton.offsets.subarray(0, 3), ...skeleton.restRotations]);
  return new Kinematics(new Clip("rest", skeleton, 1, skeleton.names, poses)).update(0);
}

function extent(positions: Float64Array, axis: number): number {
  let least = Infinity;
  let most = -Infinity;
  for (let at = axis; at < positions.length; at += 3) {
    least = Math.min(least, positions[at]!);
    most = Math.max(most, positions[at]!);
  }
  return most - least;
}
