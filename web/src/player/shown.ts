/** State of a viewer: frame, camera, look and layout. A page stores it in its address or in its data. */
import { type Actor, arrange, type Cell, type Look } from "../scene/actor";

const LAYOUTS = ["beside", "overlaid", "left", "right"] as const;
export type Layout = (typeof LAYOUTS)[number];
export const LAYOUT_NAMES: Record<Layout, string> = { beside: "Side by side", overlaid: "Overlaid", left: "Left only", right: "Right only" };

export interface Shown {
  /** Frame of the slider, from 0; as long as the first clip lasts, it is a frame of this clip. */
  frame: number;
  camera: string | null;
  look: Look;
  layout: Layout;
}

/** Return the layouts that are possible for a number of clips. */
export function layoutsOf(count: number): readonly Layout[] {
  return count === 2 ? LAYOUTS : LAYOUTS.slice(0, 2);
}

/** Return the layout with the given name; `beside` for unknown names. */
export function layoutOf(name: string | null): Layout {
  return LAYOUTS.find((one) => one === name) ?? "beside";
}

/** Return the cells of a picture with an aspect (width by height). */
export function cellsOf(actors: Actor[], layout: Layout, aspect: number): Cell[] {
  if (actors.length < 2 || !layoutsOf(actors.length).includes(layout)) return arrange(actors.length, aspect);
  const box: [number, number, number, number] = [0, 0, 1, 1];
  if (layout === "overlaid") return [{ actors: actors.map((_, index) => index), box }];
  if (layout !== "beside") return [{ actors: [layout === "left" ? 0 : 1], box }];
  return arrange(actors.length, aspect);
}
