/** Meshes of one actor. All limbs are instances of one shape, so the number of draw calls does not depend on the joints. */
import {
  BufferGeometry, Color, CylinderGeometry, Float32BufferAttribute, Group, InstancedMesh, LatheGeometry, Line,
  LineBasicMaterial, Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, OctahedronGeometry, Quaternion, RingGeometry,
  SphereGeometry, Vector2, Vector3,
} from "three";
import type { Side } from "../motion/skeleton";
import type { Actor, Look } from "./actor";
import type { Limb } from "./body";
import type { Palette } from "./stage";

const UP = new Vector3(0, 1, 0);
/** Outline of a wooden limb of length one and radius one: radius by height. */
const OUTLINE: [number, number][] = [[0.55, 0], [0.86, 0.08], [1, 0.26], [0.88, 0.58], [0.66, 0.9], [0.5, 1]];
const SHADOW_HEIGHT = 0.0015;
const PATH_HEIGHT = 0.003;

export class Figure {
  readonly group = new Group();
  private readonly looks: Record<Look, Drawn>;
  private readonly marks: Mesh<RingGeometry, MeshBasicMaterial>[];
  /** Path of the hips on the ground, over the whole clip. */
  private readonly path: Line<BufferGeometry, LineBasicMaterial>;

  constructor(readonly actor: Actor) {
    this.looks = { skeleton: skeletonOf(actor), mannequin: mannequinOf(actor) };
    this.marks = actor.clip.skeleton.feet.map(() => {
      const mark = new Mesh(new RingGeometry(0.036 * actor.body.height, 0.046 * actor.body.height, 28), new MeshBasicMaterial());
      mark.rotation.x = -Math.PI / 2;
      return mark;
    });
    const places = new Float32BufferAttribute(actor.groundPath(PATH_HEIGHT), 3);
    this.path = new Line(new BufferGeometry().setAttribute("position", places), new LineBasicMaterial());
    this.path.frustumCulled = false;
    this.group.add(this.looks.skeleton.group, this.looks.mannequin.group, this.path, ...this.marks);
  }

  /** Move all parts to the pose that the actor shows. */
  pose(look: Look, showsMarks: boolean): void {
    for (const [name, drawn] of Object.entries(this.looks)) {
      drawn.group.visible = name === look;
      if (name === look) drawn.pose(this.actor.positions);
    }
    this.path.visible = showsMarks;
    const standing = this.actor.standing();
    this.actor.clip.skeleton.feet.forEach((foot, index) => {
      const mark = this.marks[index]!;
      mark.visible = showsMarks && standing.includes(foot);
      mark.position.set(this.actor.positions[3 * foot]!, 0.004, this.actor.positions[3 * foot + 2]!);
    });
  }

  paint(palette: Palette, neutral: boolean): void {
    const { sides, feet } = this.actor.clip.skeleton;
    const ofSide = (side: Side) => (side === "left" ? palette.left : side === "right" ? palette.right : palette.bone);
    this.looks.skeleton.paint((point) => ofSide(sides[point]!), palette.shadow);
    this.looks.mannequin.paint(() => (neutral ? palette.context : palette.wood), palette.shadow);
    this.path.material.color.set(palette.context);
    feet.forEach((foot, index) => this.marks[index]!.material.color.set(ofSide(sides[foot]!)));
  }

  dispose(): void {
    for (const drawn of Object.values(this.looks)) drawn.dispose();
    for (const mark of [...this.marks, this.path]) {
      mark.geometry.dispose();
      mark.material.dispose();
    }
  }
}

/** Limbs and balls of one look, with their shadow on the ground. */
class Drawn {
  readonly group = new Group();
  private readonly limbs: InstancedMesh<BufferGeometry, MeshLambertMaterial>;
  private readonly balls: InstancedMesh<BufferGeometry, MeshLambertMaterial>;
  private readonly dark = new MeshBasicMaterial();
  private readonly matrix = new Matrix4();
  private readonly start = new Vector3();
  private readonly end = new Vector3();
  private readonly along = new Vector3();
  private readonly size = new Vector3();
  private readonly turned = new Quaternion();

  constructor(
    limb: BufferGeometry, ball: BufferGeometry, private readonly limbPieces: Limb[], private readonly ballPieces: Limb[],
    flat: boolean,
  ) {
    this.limbs = new InstancedMesh(limb, new MeshLambertMaterial({ flatShading: flat }), limbPieces.length);
    this.balls = new InstancedMesh(ball, new MeshLambertMaterial({ flatShading: flat }), ballPieces.length);
    const shadow = new Group();
    for (const mesh of [this.limbs, this.balls]) {
      const copy = new InstancedMesh(mesh.geometry, this.dark, mesh.count);
      copy.instanceMatrix = mesh.instanceMatrix; // the same limbs, pressed flat
      copy.frustumCulled = mesh.frustumCulled = false;
      shadow.add(copy);
    }
    shadow.scale.y = 1e-4;
    shadow.position.y = SHADOW_HEIGHT;
    this.group.add(this.limbs, this.balls, shadow);
  }

  pose(positions: Float64Array): void {
    this.limbPieces.forEach((piece, index) => {
      this.start.fromArray(positions, 3 * piece.from);
      this.end.fromArray(positions, 3 * piece.to);
      const length = this.along.subVectors(this.end, this.start).length();
      this.turned.setFromUnitVectors(UP, length > 0 ? this.along.divideScalar(length) : UP);
      this.matrix.compose(this.start, this.turned, this.size.set(piece.radius, length, piece.radius));
      this.limbs.setMatrixAt(index, this.matrix);
    });
    this.ballPieces.forEach((piece, index) => {
      this.start.fromArray(positions, 3 * piece.from);
      this.start.add(this.end.fromArray(positions, 3 * piece.to)).multiplyScalar(0.5);
      this.matrix.makeScale(piece.radius, piece.radius, piece.radius).setPosition(this.start);
      this.balls.setMatrixAt(index, this.matrix);
    });
    this.limbs.instanceMatrix.needsUpdate = this.balls.instanceMatrix.needsUpdate = true;
  }

  paint(colourOf: (point: number) => string, shadow: string): void {
    const colour = new Color();
    this.limbPieces.forEach((piece, index) => this.limbs.setColorAt(index, colour.set(colourOf(piece.to))));
    this.ballPieces.forEach((piece, index) => this.balls.setColorAt(index, colour.set(colourOf(piece.to))));
    for (const mesh of [this.limbs, this.balls]) if (mesh.instanceColor !== null) mesh.instanceColor.needsUpdate = true;
    this.dark.color.set(shadow);
  }

  dispose(): void {
    for (const mesh of [this.limbs, this.balls]) {
      mesh.geometry.dispose();
      mesh.material.dispose();
      mesh.dispose();
    }
    this.dark.dispose();
  }
}

/** Octahedra at the joints and four-sided bones: 16 triangles for each joint. */
function skeletonOf(actor: Actor): Drawn {
  const thick = 0.011 * actor.body.height;
  const limbs = actor.body.bones.map((bone) => ({ ...bone, radius: Math.min(thick, 3 * bone.radius) }));
  const carriers = actor.clip.skeleton.carriers();
  const joints = actor.clip.skeleton.names.map((_, joint) => joint).filter((joint) => !carriers.has(joint));
  const balls = joints.map((joint) => ({ from: joint, to: joint, radius: 1.15 * thick }));
  const bone = new CylinderGeometry(0.35, 1, 1, 4, 1, true).translate(0, 0.5, 0);
  return new Drawn(bone, new OctahedronGeometry(1), limbs, balls, true);
}

function mannequinOf(actor: Actor): Drawn {
  const outline = OUTLINE.map(([radius, height]) => new Vector2(radius, height));
  return new Drawn(new LatheGeometry(outline, 10), new SphereGeometry(1, 12, 9), actor.body.limbs, actor.body.balls, false);
}
