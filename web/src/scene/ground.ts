/** Ground of a scene: a plane with lines every metre, and every 10 cm near the figure. */
import { BufferGeometry, Float32BufferAttribute, Group, LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, PlaneGeometry } from "three";
import type { Palette } from "./stage";

const REACH_M = 14;
const FINE_REACH_M = 2;

export class Ground {
  readonly group = new Group();
  private readonly plane = new Mesh(new PlaneGeometry(4 * REACH_M, 4 * REACH_M), new MeshBasicMaterial());
  private readonly lines = new LineSegments(lattice(REACH_M, 1), new LineBasicMaterial());
  private readonly fineLines = new LineSegments(lattice(FINE_REACH_M, 0.1), new LineBasicMaterial());

  constructor() {
    this.plane.rotation.x = -Math.PI / 2;
    this.plane.position.y = -0.006;
    this.fineLines.position.y = -0.004;
    this.lines.position.y = -0.002;
    // Legs of a take whose origin is at the hips are below the ground, and must be seen there: the ground is drawn first.
    for (const [order, part] of [this.plane, this.fineLines, this.lines].entries()) {
      part.renderOrder = order - 3;
      part.material.depthWrite = false;
      this.group.add(part);
    }
  }

  paint(palette: Palette): void {
    this.plane.material.color.set(palette.ground);
    this.lines.material.color.set(palette.grid);
    this.fineLines.material.color.set(palette.gridFine);
  }

  /** Move the drawn part of the ground under a point; the lines stay at whole metres of the world. */
  centre(x: number, z: number): void {
    this.group.position.set(Math.round(x), 0, Math.round(z));
  }

  dispose(): void {
    for (const part of [this.plane, this.lines, this.fineLines]) {
      part.geometry.dispose();
      part.material.dispose();
    }
  }
}

function lattice(reach: number, step: number): BufferGeometry {
  const count = Math.round(reach / step);
  const ends: number[] = [];
  for (let line = -count; line <= count; line++) {
    const at = line * step;
    ends.push(at, 0, -reach, at, 0, reach, -reach, 0, at, reach, 0, at);
  }
  return new BufferGeometry().setAttribute("position", new Float32BufferAttribute(ends, 3));
}
