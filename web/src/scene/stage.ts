/** Interface of the two ways to draw actors: with WebGL, or as side views on a 2D canvas. */
import type { Actor, Cell, Look } from "./actor";
import type { OrbitCamera } from "./camera";

/** Colours of a scene as hexadecimal texts, read from the tokens of the style sheet. */
export interface Palette {
  base: string;
  ground: string;
  grid: string;
  gridFine: string;
  shadow: string;
  bone: string;
  wood: string;
  left: string;
  right: string;
  context: string;
}

export interface StageOptions {
  /** Whether pictures are for a test: without smoothing, at one pixel per point, and readable afterwards. */
  test: boolean;
  /** Whether all mannequins have the same neutral colour, and no ground marks are shown. */
  neutral: boolean;
}

export interface Stage {
  readonly kind: "webgl" | "canvas";
  /** What draws the pictures, for the status bar and tests. */
  readonly renderer: string;
  setActors(actors: Actor[]): void;
  setPalette(palette: Palette): void;
  resize(width: number, height: number): void;
  draw(cells: Cell[], camera: OrbitCamera, look: Look): void;
  /** Number of draw calls and triangles of the last picture. */
  cost(): { calls: number; triangles: number };
  dispose(): void;
}

/** Return the best stage that this browser offers; the three-dimensional one is loaded only here. */
export async function openStage(canvas: HTMLCanvasElement, options: StageOptions): Promise<Stage> {
  const { WebGlStage } = await import("./webgl");
  try {
    return new WebGlStage(canvas, options);
  } catch {
    const fresh = canvas.cloneNode() as HTMLCanvasElement; // a canvas that was asked for WebGL may refuse 2D
    canvas.replaceWith(fresh);
    const { SideViewStage } = await import("./sideView");
    return new SideViewStage(fresh);
  }
}

/** Read the colours of the scene from the style sheet. */
export function readPalette(): Palette {
  const style = getComputedStyle(document.documentElement);
  const of = (name: string) => style.getPropertyValue(`--${name}`).trim();
  return {
    base: of("base"), ground: of("ground"), grid: of("grid"), gridFine: of("grid-fine"), shadow: of("shadow"),
    bone: of("bone"), wood: of("wood"), left: of("left"), right: of("right"), context: of("context"),
  };
}
