/** Forward kinematics: positions of all points of a skeleton in the world, for one pose. Quaternions are w, x, y, z. */
import type { Clip } from "./clip";

/** Memory for the kinematics of one clip, which every frame reuses. */
export class Kinematics {
  /** (points, 3) positions in metres, Y up; overwritten by `update`. */
  readonly positions: Float64Array;
  private readonly rotations: Float64Array;
  private readonly columns: Int32Array;
  private readonly slots: Int32Array;

  constructor(readonly clip: Clip) {
    const { skeleton } = clip;
    this.positions = new Float64Array(3 * skeleton.pointCount);
    this.rotations = new Float64Array(4 * skeleton.jointCount);
    this.columns = Int32Array.from(skeleton.names, (name) => 3 + 4 * clip.joints.indexOf(name));
    this.slots = Int32Array.from(skeleton.names, (name) => clip.translatedJoints.indexOf(name));
  }

  /** Compute `positions` for a frame, and return it. */
  update(frame: number): Float64Array {
    const { skeleton, poses, translations, translatedJoints } = this.clip;
    const { positions, rotations } = this;
    const row = frame * this.clip.width;
    positions[0] = poses[row]!;
    positions[1] = poses[row + 1]!;
    positions[2] = poses[row + 2]!;
    for (let point = 0; point < skeleton.pointCount; point++) {
      if (point > 0) {
        const slot = point < skeleton.jointCount ? this.slots[point]! : -1;
        const source = slot < 0 ? skeleton.offsets : translations;
        const at = slot < 0 ? 3 * point : 3 * (frame * translatedJoints.length + slot);
        place(rotations, positions, skeleton.parents[point]!, point, source[at]!, source[at + 1]!, source[at + 2]!);
      }
      if (point < skeleton.jointCount) {
        turn(rotations, skeleton.parents[point]!, point, poses, row + this.columns[point]!);
      }
    }
    return positions;
  }
}

/** Set the rotation of a joint in the world: that of its parent, then its own. */
function turn(rotations: Float64Array, parent: number, joint: number, poses: Float32Array, at: number): void {
  const w = poses[at]!, x = poses[at + 1]!, y = poses[at + 2]!, z = poses[at + 3]!;
  const to = 4 * joint;
  if (parent < 0) {
    rotations.set([w, x, y, z], to);
    return;
  }
  const from = 4 * parent;
  const a = rotations[from]!, b = rotations[from + 1]!, c = rotations[from + 2]!, d = rotations[from + 3]!;
  rotations[to] = a * w - b * x - c * y - d * z;
  rotations[to + 1] = a * x + b * w + c * z - d * y;
  rotations[to + 2] = a * y - b * z + c * w + d * x;
  rotations[to + 3] = a * z + b * y - c * x + d * w;
}

/** Set the position of a point: that of its parent, and its offset as the parent turns it. */
function place(
  rotations: Float64Array, positions: Float64Array, parent: number, point: number, px: number, py: number, pz: number,
): void {
  const from = 4 * parent;
  const w = rotations[from]!, x = rotations[from + 1]!, y = rotations[from + 2]!, z = rotations[from + 3]!;
  const tx = 2 * (y * pz - z * py);
  const ty = 2 * (z * px - x * pz);
  const tz = 2 * (x * py - y * px);
  const to = 3 * point;
  const base = 3 * parent;
  positions[to] = positions[base]! + px + w * tx + y * tz - z * ty;
  positions[to + 1] = positions[base + 1]! + py + w * ty + z * tx - x * tz;
  positions[to + 2] = positions[base + 2]! + pz + w * tz + x * ty - y * tx;
}
