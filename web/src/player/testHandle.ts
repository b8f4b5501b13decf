/** State of the scene for tests, at `window.marey` of pages with `?test=1`. Tests compare it instead of pictures. */
import type { Actor } from "../scene/actor";
import type { OrbitCamera } from "../scene/camera";
import type { Stage } from "../scene/stage";
import type { Clock } from "./clock.svelte";

export interface SceneState {
  stage: "webgl" | "canvas";
  renderer: string;
  calls: number;
  triangles: number;
  seconds: number;
  camera: string;
  actors: { name: string; frame: number; joints: string[]; positions: number[]; standing: number[] }[];
}

declare global {
  interface Window {
    marey?: SceneState;
  }
}

export function showState(stage: Stage, actors: Actor[], clock: Clock, camera: OrbitCamera): void {
  window.marey = {
    stage: stage.kind,
    renderer: stage.renderer,
    ...stage.cost(),
    seconds: clock.seconds,
    camera: camera.toString(),
    actors: actors.map((actor) => ({
      name: actor.clip.name,
      frame: actor.frame,
      joints: actor.clip.skeleton.names,
      positions: [...actor.positions.subarray(0, 3 * actor.clip.skeleton.jointCount)],
      standing: actor.standing(),
    })),
  };
}
