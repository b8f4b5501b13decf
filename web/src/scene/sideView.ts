/** Stage for browsers without WebGL: the skeleton from the camera's direction, drawn as lines on a 2D canvas. */
import type { Actor, Cell } from "./actor";
import type { OrbitCamera } from "./camera";
import type { Palette, Stage } from "./stage";

export class SideViewStage implements Stage {
  readonly kind = "canvas";
  readonly renderer = "2D canvas";
  private readonly context: CanvasRenderingContext2D;
  private actors: Actor[] = [];
  private palette: Palette | null = null;
  private strokes = 0;
  /** Pixels of the canvas per pixel of the style sheet. */
  private ratio = 1;

  constructor(private readonly canvas: HTMLCanvasElement) {
    const context = canvas.getContext("2d");
    if (context === null) throw new Error("this browser offers no canvas to draw on");
    this.context = context;
  }

  setActors(actors: Actor[]): void {
    this.actors = actors;
  }

  setPalette(palette: Palette): void {
    this.palette = palette;
  }

  resize(width: number, height: number): void {
    this.ratio = Math.min(devicePixelRatio, 2);
    this.canvas.width = Math.max(Math.round(width * this.ratio), 1);
    this.canvas.height = Math.max(Math.round(height * this.ratio), 1);
  }

  draw(cells: Cell[], camera: OrbitCamera): void {
    const { context, palette } = this;
    if (palette === null) return;
    const { width, height } = this.canvas;
    this.strokes = 0;
    context.fillStyle = palette.base;
    context.fillRect(0, 0, width, height);
    for (const cell of cells) {
      const [left, bottom, wide, high] = cell.box;
      context.save();
      context.beginPath();
      context.rect(left * width, (1 - bottom - high) * height, wide * width, high * height);
      context.clip();
      context.translate((left + wide / 2) * width, (1 - bottom - high / 2) * height);
      for (const index of cell.actors) this.drawActor(this.actors[index]!, camera, high * height, wide * width, palette);
      context.restore();
    }
  }

  private drawActor(actor: Actor, camera: OrbitCamera, high: number, wide: number, palette: Palette): void {
    const { context } = this;
    const { positions } = actor;
    const { skeleton } = actor.clip;
    const yaw = (camera.yaw * Math.PI) / 180;
    const [cx, cy, cz] = actor.centre(camera.follows);
    const scale = (Math.min(high, 1.4 * wide) * 1.85) / (camera.distance * actor.body.height);
    const place = (point: number): [number, number] => {
      const [x, y, z] = [0, 1, 2].map((axis) => positions[3 * point + axis]!) as [number, number, number];
      const across = (x - cx - camera.shift[0]) * Math.cos(yaw) - (z - cz - camera.shift[2]) * Math.sin(yaw);
      return [scale * across, -scale * (y - cy - camera.shift[1])];
    };
    const ground = scale * (cy + camera.shift[1]);
    this.line(palette.grid, this.ratio, [-wide, ground], [wide, ground]);
    context.lineCap = "round";
    for (const limb of actor.body.bones) {
      const side = skeleton.sides[limb.to];
      const colour = side === "left" ? palette.left : side === "right" ? palette.right : palette.bone;
      this.line(colour, Math.max(2 * this.ratio, 0.5 * scale * limb.radius), place(limb.from), place(limb.to));
    }
    for (const foot of actor.standing()) {
      const [x] = place(foot);
      const [half, below] = [9 * this.ratio, ground + 3 * this.ratio];
      this.line(skeleton.sides[foot] === "left" ? palette.left : palette.right, 4 * this.ratio, [x - half, below], [x + half, below]);
    }
  }

  private line(colour: string, width: number, from: [number, number], to: [number, number]): void {
    this.context.strokeStyle = colour;
    this.context.lineWidth = width;
    this.context.beginPath();
    this.context.moveTo(...from);
    this.context.lineTo(...to);
    this.context.stroke();
    this.strokes += 1;
  }

  cost(): { calls: number; triangles: number } {
    return { calls: this.strokes, triangles: 0 };
  }

  dispose(): void {
    this.actors = [];
  }
}
