/** Poses in the compact form of pages without a server, which `client/marey_client/poses/packing.py` writes. */
import { Clip } from "./clip";
import { type HierarchyDocument, type MappingDocument, Skeleton } from "./skeleton";

/** Motions of a page, and how they are shown at first. */
export interface PackedPage {
  format: number;
  title: string;
  motions: PackedMotion[];
}

export interface PackedMotion {
  name: string;
  hierarchy: HierarchyDocument;
  mapping: MappingDocument | null;
  frame_rate_hz: number;
  frames: number;
  joints: string[];
  translated_joints: string[];
  angle_step_rad: number;
  length_step_m: number;
  /** Packed rotation vectors: three 16-bit channels for each joint. */
  rotations: string;
  /** Packed lengths: three 32-bit channels for the root, and three for each translated joint. */
  lengths: string;
}

/** Version of the form that this page can read. */
const FORMAT = 1;

/** Return the clips of a page. Throws a RangeError if the page has none, or if its data are not readable. */
export async function unpackPage(text: string): Promise<{ title: string; clips: Clip[] }> {
  if (text.trim() === "") throw new RangeError("this page contains no motion; `marey view CLIP --out FILE.html` writes pages that do");
  const page = JSON.parse(text) as PackedPage;
  if (page.format !== FORMAT) throw new RangeError(`the motion has the format version ${page.format}, but this page reads version ${FORMAT}`);
  return { title: page.title, clips: await Promise.all(page.motions.map(unpackMotion)) };
}

export async function unpackMotion(motion: PackedMotion): Promise<Clip> {
  const { frames, joints } = motion;
  const moved = motion.translated_joints.length;
  const turns = new Int16Array(3 * joints.length * frames);
  const lengths = new Int32Array(3 * (1 + moved) * frames);
  restore(await inflate(motion.rotations), turns, frames);
  restore(await inflate(motion.lengths), lengths, frames);
  const width = 3 + 4 * joints.length;
  const poses = new Float32Array(frames * width);
  const translations = new Float32Array(3 * moved * frames);
  for (let frame = 0; frame < frames; frame++) {
    const length = (channel: number) => lengths[channel * frames + frame]! * motion.length_step_m;
    for (let axis = 0; axis < 3; axis++) poses[frame * width + axis] = length(axis);
    for (let at = 0; at < 3 * moved; at++) translations[3 * moved * frame + at] = length(3 + at);
    for (let joint = 0; joint < joints.length; joint++) {
      const part = (axis: number) => turns[(3 * joint + axis) * frames + frame]! * motion.angle_step_rad;
      writeRotation(poses, frame * width + 3 + 4 * joint, part(0), part(1), part(2));
    }
  }
  const skeleton = new Skeleton(motion.hierarchy, motion.mapping);
  return new Clip(motion.name, skeleton, motion.frame_rate_hz, joints, poses, motion.translated_joints, translations);
}

/** Write the quaternion w, x, y, z of a rotation vector in radians. */
function writeRotation(poses: Float32Array, at: number, x: number, y: number, z: number): void {
  const angle = Math.hypot(x, y, z);
  const factor = angle > 0 ? Math.sin(angle / 2) / angle : 0.5;
  poses[at] = Math.cos(angle / 2);
  poses[at + 1] = factor * x;
  poses[at + 2] = factor * y;
  poses[at + 3] = factor * z;
}

/** Fill integers, channel by channel, from byte planes of their folded differences; both arrays wrap around. */
function restore(planes: Uint8Array, integers: Int16Array | Int32Array, frames: number): void {
  const count = integers.length;
  const bytes = integers.BYTES_PER_ELEMENT;
  if (planes.length !== count * bytes) throw new RangeError("the size of the packed poses does not match the number of frames");
  for (let index = 0; index < count; index++) {
    let folded = 0;
    for (let plane = 0; plane < bytes; plane++) folded |= planes[plane * count + index]! << (8 * plane);
    const step = (folded >>> 1) ^ -(folded & 1);
    integers[index] = index % frames === 0 ? step : step + integers[index - 1]!;
  }
}

async function inflate(text: string): Promise<Uint8Array> {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
