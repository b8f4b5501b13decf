/** Skeletons: hierarchies of joints, with what a viewer derives from them: sides of the body, feet, head, thickness. */

export type Side = "left" | "right" | "centre";

export interface HierarchyDocument {
  joints: { name: string; parent: number; offset: [number, number, number]; rest_rotation?: [number, number, number, number] }[];
  end_sites?: { joint: number; offset: [number, number, number] }[];
}

export interface MappingDocument {
  joints?: Record<string, string>;
}

const LEFT = /(^|[^a-z])(l|left)([^a-z]|$)|^left|^l(?=[A-Z_])|(^|[^a-zA-Z])Left/;
const RIGHT = /(^|[^a-z])(r|right)([^a-z]|$)|^right|^r(?=[A-Z_])|(^|[^a-zA-Z])Right/;
const FEET = ["left_toe", "right_toe", "left_heel", "right_heel"];
const FEET_WITHOUT_TOES = ["left_ankle", "right_ankle"];

/** A skeleton in metres with Y up. Points are the joints, then the end sites. */
export class Skeleton {
  readonly names: string[];
  readonly jointCount: number;
  readonly pointCount: number;
  /** Index of the parent of each point; −1 for the root. */
  readonly parents: Int32Array;
  /** Position of each point in the frame of its parent. */
  readonly offsets: Float64Array;
  readonly restRotations: Float64Array;
  readonly sides: Side[];
  /** Joints that touch the ground, by which contacts are detected. */
  readonly feet: number[];
  readonly head: number;
  /** Joint at which the body begins; the bones that lead to it only carry the body through space, and are not drawn. */
  readonly hips: number;
  /** Joints at the left and the right end of the hips, or of another pair of bones that branch off there; null without one. */
  readonly across: readonly [number, number] | null;

  constructor(hierarchy: HierarchyDocument, mapping: MappingDocument | null = null) {
    const joints = hierarchy.joints;
    const ends = hierarchy.end_sites ?? [];
    this.names = joints.map((joint) => joint.name);
    this.jointCount = joints.length;
    this.pointCount = joints.length + ends.length;
    this.parents = Int32Array.from([...joints.map((joint) => joint.parent), ...ends.map((end) => end.joint)]);
    this.offsets = Float64Array.from([...joints, ...ends].flatMap((point) => point.offset));
    this.restRotations = Float64Array.from(joints.flatMap((joint) => joint.rest_rotation ?? [1, 0, 0, 0]));
    const standard = new Map(Object.entries(mapping?.joints ?? {}).map(([name, joint]) => [name, this.names.indexOf(joint)]));
    this.sides = this.findSides(standard);
    this.feet = this.findFeet(standard);
    this.head = standard.get("head") ?? this.names.findIndex((name) => /head/i.test(name));
    this.hips = this.findHips(standard);
    this.across = this.findAcross(standard);
  }

  /** The joints above the hips, which are no part of the body. */
  carriers(): Set<number> {
    const above = new Set<number>();
    for (let joint = this.parents[this.hips]!; joint >= 0; joint = this.parents[joint]!) above.add(joint);
    return above;
  }

  /** Length of the bone from the parent to a point, in metres. */
  boneLength(point: number): number {
    return Math.hypot(this.offsets[3 * point]!, this.offsets[3 * point + 1]!, this.offsets[3 * point + 2]!);
  }

  /** Total length of the bone that leads to each point and of all bones below it, in metres. */
  subtreeLengths(): Float64Array {
    const lengths = Float64Array.from({ length: this.pointCount }, (_, point) => (point === 0 ? 0 : this.boneLength(point)));
    for (let point = this.pointCount - 1; point > 0; point--) lengths[this.parents[point]!]! += lengths[point]!;
    return lengths;
  }

  /** Return the joint from which both legs branch off; between it and a leg, some skeletons have another joint. */
  private findHips(standard: Map<string, number>): number {
    const legs = ["left_hip", "right_hip"].map((name) => standard.get(name) ?? -1).filter((leg) => leg > 0);
    const [left, right] = [legs[0], legs.at(-1)];
    if (left === undefined || right === undefined) return this.firstBranching();
    const above = new Set<number>();
    for (let joint = this.parents[left]!; joint >= 0; joint = this.parents[joint]!) above.add(joint);
    let hips = this.parents[right]!;
    while (hips > 0 && !above.has(hips)) hips = this.parents[hips]!;
    return hips;
  }

  private firstBranching(): number {
    const children = (joint: number) => this.parents.reduce((count, parent) => count + (parent === joint ? 1 : 0), 0);
    const found = this.names.findIndex((_, joint) => children(joint) > 1);
    return Math.max(found, 0);
  }

  private findSides(standard: Map<string, number>): Side[] {
    const sides: Side[] = new Array<Side>(this.pointCount).fill("centre");
    const known = new Map<number, Side>();
    for (const [name, joint] of standard) {
      if (name.startsWith("left_")) known.set(joint, "left");
      if (name.startsWith("right_")) known.set(joint, "right");
    }
    for (let point = 0; point < this.pointCount; point++) {
      const parent = this.parents[point]!;
      const name = this.names[point] ?? "";
      const named: Side | undefined = LEFT.test(name) ? "left" : RIGHT.test(name) ? "right" : undefined;
      sides[point] = known.get(point) ?? named ?? (parent < 0 ? "centre" : sides[parent]!);
    }
    return sides;
  }

  private findAcross(standard: Map<string, number>): [number, number] | null {
    const ofSide = (side: Side) => {
      const mapped = standard.get(`${side}_hip`) ?? -1;
      return mapped >= 0 ? mapped : this.parents.findIndex((parent, point) => parent === this.hips && this.sides[point] === side);
    };
    const [left, right] = [ofSide("left"), ofSide("right")];
    return left >= 0 && right >= 0 ? [left, right] : null;
  }

  private findFeet(standard: Map<string, number>): number[] {
    const of = (names: string[]) => names.map((name) => standard.get(name)).filter((joint) => joint !== undefined && joint >= 0);
    const mapped = of(FEET) as number[];
    if (mapped.length > 0) return mapped;
    const ankles = of(FEET_WITHOUT_TOES) as number[];
    if (ankles.length > 0) return ankles;
    const toes = this.names.flatMap((name, joint) => (/toe/i.test(name) ? [joint] : []));
    return toes.length > 0 ? toes : this.names.flatMap((name, joint) => (/foot|ankle/i.test(name) ? [joint] : []));
  }
}
