import { describe, expect, it } from "vitest";
import { actionOf } from "../src/player/keys";
import { OrbitCamera } from "../src/scene/camera";

describe("a camera", () => {
  it("looks from the front, the left side and the top, wherever the body faces", () => {
    const camera = new OrbitCamera();
    camera.face(-170);
    expect(camera.toString()).toBe("-135,12,3");
    const seen = [0, 100, 170, -90].map((heading) => {
      camera.lookNext(heading);
      return [camera.yaw, camera.pitch];
    });
    expect(seen).toEqual([[0, 8], [-170, 8], [170, 89], [-90, 8]]);
    camera.turn(10, 0);
    camera.lookNext(0);
    expect([camera.yaw, camera.pitch]).toEqual([0, 8]); // from the first view again
  });

  it("is turned by one finger, and zoomed and moved by two", () => {
    const camera = new OrbitCamera();
    const surface = Object.assign(new EventTarget(), { setPointerCapture: () => {}, clientHeight: 600 });
    const detach = camera.attach(surface as unknown as HTMLElement, () => 1.8, () => {});
    const touch = (type: string, pointerId: number, clientX: number, clientY: number) =>
      surface.dispatchEvent(Object.assign(new Event(type), { pointerId, clientX, clientY, shiftKey: false, buttons: 1 }));
    touch("pointerdown", 1, 100, 300);
    touch("pointermove", 1, 150, 300);
    expect([camera.yaw, camera.shift]).toEqual([35 - 50 * 0.35, [0, 0, 0]]);
    const { yaw } = camera;
    touch("pointerdown", 2, 250, 300);
    touch("pointermove", 1, 150, 360);
    touch("pointermove", 2, 250, 360);
    expect(camera.yaw).toBe(yaw);
    expect(camera.distance).toBeCloseTo(3);
    expect(camera.shift[1]).toBeCloseTo((60 * 3 * 1.8) / 600, 1);
    touch("pointermove", 2, 350, 360);
    expect(camera.distance).toBeCloseTo(1.5);
    detach();
    touch("pointerup", 2, 350, 360);
    touch("pointermove", 1, 0, 0);
    expect(camera.yaw).toBe(yaw);
  });
});

describe("the keys of the player", () => {
  const pressed = (key: string, shiftKey = false) => actionOf({ key, shiftKey, target: null } as unknown as KeyboardEvent);

  it("work on keyboards on which signs need Shift, and on those on which they do not", () => {
    expect([pressed("="), pressed("=", true), pressed("+"), pressed("+", true)]).toEqual(["faster", "faster", "faster", "faster"]);
    expect([pressed("-"), pressed("?"), pressed("?", true)]).toEqual(["slower", "help", "help"]);
    expect([pressed("f"), pressed("F", true), pressed("V", true)]).toEqual(["frame", "follow", null]);
  });

  it("turn the camera and move it nearer and farther", () => {
    expect(["a", "d", "w", "s"].map((key) => pressed(key))).toEqual(["turnLeft", "turnRight", "nearer", "farther"]);
  });
});
