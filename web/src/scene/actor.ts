/** One character of a scene: a clip, the pose that is shown, its body and its contacts with the ground. */
import type { Clip } from "../motion/clip";
import { findContacts } from "../motion/contacts";
import { Kinematics } from "../motion/kinematics";
import { type Body, shapeBody } from "./body";

export type Look = "skeleton" | "mannequin";

/** Depth in metres below the ground from which a body is thought to have its origin at the hips. */
const DEEP_M = 0.3;

export class Actor {
  readonly body: Body;
  readonly contacts: Uint8Array[];
  frame = 0;
  private readonly kinematics: Kinematics;
  /** Place of the middle of the body in the first frame. */
  private readonly start: [number, number];
  /** Height in metres from which the height of the body counts: 0, or that of the feet if they are below the ground. */
  private readonly base: number;

  constructor(readonly clip: Clip) {
    this.body = shapeBody(clip.skeleton);
    this.contacts = findContacts(clip);
    this.kinematics = new Kinematics(clip);
    this.kinematics.update(0);
    this.start = this.place();
    const lowest = this.positions.filter((_, at) => at % 3 === 1).reduce((least, y) => Math.min(least, y), 0);
    this.base = lowest < -DEEP_M ? lowest : 0;
  }

  /** Positions of all points in metres. */
  get positions(): Float64Array {
    return this.kinematics.positions;
  }

  /** Show the pose at a time of the common clock, in seconds. */
  seek(seconds: number): void {
    this.frame = this.clip.frameAt(seconds);
    this.kinematics.update(this.frame);
  }

  /** Return the indices of the feet that touch the ground in this frame. */
  standing(): number[] {
    return this.clip.skeleton.feet.filter((_, index) => this.contacts[index]![this.frame] === 1);
  }

  /** Direction that the body faces in this frame: degrees about the vertical, 0 for +z, 90 for +x; 0 if it is unknown. */
  get heading(): number {
    const { across } = this.clip.skeleton;
    if (across === null) return 0;
    const [left, right] = across;
    const [x, z] = [0, 2].map((axis) => this.positions[3 * left + axis]! - this.positions[3 * right + axis]!) as [number, number];
    return x === 0 && z === 0 ? 0 : (Math.atan2(-z, x) * 180) / Math.PI;
  }

  /** Return the points of the ground below the hips in all frames, at a height in metres. */
  groundPath(height: number): Float32Array {
    const kinematics = new Kinematics(this.clip);
    const { hips } = this.clip.skeleton;
    const path = new Float32Array(3 * this.clip.frames);
    for (let frame = 0; frame < this.clip.frames; frame++) {
      const positions = kinematics.update(frame);
      path.set([positions[3 * hips]!, height, positions[3 * hips + 2]!], 3 * frame);
    }
    return path;
  }

  /** Point that a camera looks at: below or above the middle of the body, at half its height. */
  centre(follows: boolean): [number, number, number] {
    const [x, z] = follows ? this.place() : this.start;
    return [x, this.base + 0.52 * this.body.height, z];
  }

  private place(): [number, number] {
    const { middle } = this.body;
    const mean = (axis: number) => middle.reduce((sum, joint) => sum + this.positions[3 * joint + axis]!, 0) / middle.length;
    return [mean(0), mean(2)];
  }
}

export interface Cell {
  /** Indices of the actors that the cell shows. */
  actors: number[];
  /** Left, bottom, width and height as shares of the canvas. */
  box: [number, number, number, number];
}

/** Width by height of the cells of many actors. */
const UPRIGHT = 0.75;

/** Return cells for actors side by side: in one row, or in two columns if the canvas is higher than wide. */
export function arrange(count: number, aspect: number): Cell[] {
  const few = count <= 3 ? (aspect > 1 ? count : 1) : aspect > 2 ? count : 2;
  const many = Math.max(Math.min(Math.floor(Math.sqrt((count * aspect) / UPRIGHT)), count), 2);
  const columns = count <= 4 ? Math.max(few, 1) : many;
  const rows = Math.ceil(count / columns);
  return Array.from({ length: count }, (_, index) => ({
    actors: [index],
    box: [(index % columns) / columns, 1 - (Math.floor(index / columns) + 1) / rows, 1 / columns, 1 / rows],
  }));
}
