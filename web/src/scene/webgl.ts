/** Stage that draws actors with WebGL: ground, skeletons or mannequins, contact marks. */
import {
  Color, DirectionalLight, Fog, HemisphereLight, PerspectiveCamera, Scene, WebGLRenderer,
} from "three";
import type { Actor, Cell, Look } from "./actor";
import type { OrbitCamera } from "./camera";
import { Figure } from "./figure";
import { Ground } from "./ground";
import type { Palette, Stage, StageOptions } from "./stage";

const FIELD_OF_VIEW = 32;
/** Distance from which a body fills the height of the picture, in units of its height. */
const FITTING = 0.78;
const SOFTWARE = /swiftshader|llvmpipe|software/i;

export class WebGlStage implements Stage {
  readonly kind = "webgl";
  readonly renderer: string;
  private readonly gl: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly lens = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.05, 120);
  private readonly ground = new Ground();
  private figures: Figure[] = [];
  private palette: Palette | null = null;
  private width = 1;
  private height = 1;
  private spent = { calls: 0, triangles: 0 };

  constructor(canvas: HTMLCanvasElement, private readonly options: StageOptions) {
    const software = SOFTWARE.test(rendererName());
    this.gl = new WebGLRenderer({
      canvas,
      antialias: !options.test && !software, // on a processor, smoothing triples the time of a picture
      preserveDrawingBuffer: options.test,
      powerPreference: "high-performance",
    });
    this.renderer = rendererName(this.gl.getContext());
    this.gl.setPixelRatio(options.test || software ? 1 : Math.min(devicePixelRatio, 2));
    this.gl.setScissorTest(true);
    this.gl.info.autoReset = false;
    this.scene.fog = new Fog(0, 6, 18);
    const key = new DirectionalLight(0xffffff, 2.2);
    key.position.set(2, 5, 3);
    this.scene.add(this.ground.group, new HemisphereLight(0xffffff, 0x555a66, 1.5), key);
  }

  setActors(actors: Actor[]): void {
    for (const figure of this.figures) {
      this.scene.remove(figure.group);
      figure.dispose();
    }
    this.figures = actors.map((actor) => new Figure(actor));
    this.scene.add(...this.figures.map((figure) => figure.group));
    if (this.palette !== null) this.setPalette(this.palette);
  }

  setPalette(palette: Palette): void {
    this.palette = palette;
    this.scene.background = new Color(palette.base);
    (this.scene.fog as Fog).color.set(palette.base);
    this.ground.paint(palette);
    for (const figure of this.figures) figure.paint(palette, this.options.neutral);
  }

  resize(width: number, height: number): void {
    this.width = Math.max(width, 1);
    this.height = Math.max(height, 1);
    this.gl.setSize(this.width, this.height, false);
  }

  draw(cells: Cell[], camera: OrbitCamera, look: Look): void {
    this.gl.info.reset();
    for (const figure of this.figures) figure.pose(look, !this.options.neutral);
    for (const cell of cells) {
      const [left, bottom, width, height] = [
        cell.box[0] * this.width, cell.box[1] * this.height, cell.box[2] * this.width, cell.box[3] * this.height,
      ];
      this.gl.setViewport(left, bottom, width, height);
      this.gl.setScissor(left, bottom, width, height);
      this.figures.forEach((figure, index) => (figure.group.visible = cell.actors.includes(index)));
      const leader = this.figures[cell.actors[0] ?? 0];
      if (leader === undefined) continue;
      this.aim(leader.actor, camera, width / height);
      this.gl.render(this.scene, this.lens);
    }
    this.spent = { calls: this.gl.info.render.calls, triangles: this.gl.info.render.triangles };
  }

  cost(): { calls: number; triangles: number } {
    return this.spent;
  }

  dispose(): void {
    for (const figure of this.figures) figure.dispose();
    this.ground.dispose();
    this.gl.dispose();
  }

  private aim(actor: Actor, camera: OrbitCamera, aspect: number): void {
    const [x, y, z] = actor.centre(camera.follows);
    const target = [x + camera.shift[0], y + camera.shift[1], z + camera.shift[2]] as const;
    const yaw = (camera.yaw * Math.PI) / 180;
    const pitch = (camera.pitch * Math.PI) / 180;
    const wide = Math.min(aspect / 0.75, 1); // step back where the picture is narrow
    const distance = (camera.distance * actor.body.height * FITTING) / wide;
    this.lens.aspect = aspect;
    this.lens.position.set(
      target[0] + distance * Math.cos(pitch) * Math.sin(yaw),
      target[1] + distance * Math.sin(pitch),
      target[2] + distance * Math.cos(pitch) * Math.cos(yaw),
    );
    this.lens.lookAt(...target);
    this.lens.updateProjectionMatrix();
    const fog = this.scene.fog as Fog;
    fog.near = distance + 2;
    fog.far = distance + 12;
    this.ground.centre(target[0], target[2]);
  }
}

/** Return what draws the pictures. Throws an Error if the browser offers no WebGL 2. */
function rendererName(given?: WebGLRenderingContext | WebGL2RenderingContext): string {
  const context = given ?? document.createElement("canvas").getContext("webgl2");
  if (context === null) throw new Error("this browser offers no WebGL 2");
  const details = context.getExtension("WEBGL_debug_renderer_info");
  const name = String(context.getParameter(details?.UNMASKED_RENDERER_WEBGL ?? context.RENDERER));
  if (given === undefined) context.getExtension("WEBGL_lose_context")?.loseContext();
  return name;
}
