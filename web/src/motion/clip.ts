/** Clips: poses of a skeleton over time, as a plain class of typed arrays outside the state of the user interface. */
import { decodeBlocks } from "../wire/blocks";
import type { Tree } from "../wire/messagepack";
import type { Skeleton } from "./skeleton";

export class Clip {
  readonly width: number;
  readonly frames: number;

  constructor(
    readonly name: string,
    readonly skeleton: Skeleton,
    readonly frameRate: number,
    readonly joints: string[],
    /** [frames, 3 + 4 · joints]: translation of the root in metres, then rotations w, x, y, z. */
    readonly poses: Float32Array,
    readonly translatedJoints: string[] = [],
    /** [frames, translated joints, 3]: metres, in place of the offsets of the skeleton. */
    readonly translations: Float32Array = new Float32Array(0),
  ) {
    this.width = 3 + 4 * joints.length;
    this.frames = poses.length / this.width;
    if (!Number.isInteger(this.frames) || this.frames < 1) throw new RangeError("the number of columns of the poses does not match the number of joints");
    if (translations.length !== 3 * this.frames * translatedJoints.length) {
      throw new RangeError("the number of translations does not match the number of frames");
    }
    const missing = skeleton.names.find((joint) => !joints.includes(joint));
    if (missing !== undefined) throw new RangeError(`the motion has no rotation of the joint ${missing}`);
  }

  get duration(): number {
    return this.frames / this.frameRate;
  }

  /** The frame at a time; before the start it is the first, after the end the last. */
  frameAt(seconds: number): number {
    return Math.min(Math.max(Math.floor(seconds * this.frameRate + 1e-6), 0), this.frames - 1);
  }
}

export interface SkeletonReference {
  item: string;
  revision: number;
}

/** Return the skeleton to which a motion document refers. */
export function skeletonOf(document: Tree): SkeletonReference {
  const { skeleton } = document as unknown as { skeleton: Partial<SkeletonReference> };
  if (typeof skeleton?.item !== "string" || typeof skeleton.revision !== "number") {
    throw new RangeError("the motion refers to no skeleton");
  }
  return { item: skeleton.item, revision: skeleton.revision };
}

/** Return the clip of a motion document whose arrays are in blocks. */
export function clipOf(name: string, document: Tree, skeleton: Skeleton): Clip {
  const motion = document as {
    frame_rate_hz: number;
    joints: string[];
    poses: { data: Uint8Array };
    translations?: { data: Uint8Array } | null;
    translated_joints?: string[];
  };
  return new Clip(
    name,
    skeleton,
    motion.frame_rate_hz,
    motion.joints,
    decodeBlocks(motion.poses.data).values,
    motion.translated_joints ?? [],
    motion.translations ? decodeBlocks(motion.translations.data).values : undefined,
  );
}
