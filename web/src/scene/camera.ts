/** Camera that orbits a figure, and its text in addresses: yaw and pitch in degrees, distance in metres. */

export const NAMED_CAMERAS = { front: [0, 8], side: [90, 8], top: [0, 89] } as const;
export type CameraName = keyof typeof NAMED_CAMERAS;

const MOST_PITCH = 89;
const DEGREES_PER_PIXEL = 0.35;

export class OrbitCamera {
  yaw = 35;
  pitch = 12;
  /** Distance from the figure in units of its height. */
  distance = 3;
  /** Shift of the point that the camera looks at, in metres. */
  shift: [number, number, number] = [0, 0, 0];
  /** Whether the camera moves along with the root of the figure. */
  follows = true;

  /** Read a text such as `35,12,2.6`; other texts change nothing. */
  read(text: string | null): void {
    const numbers = (text ?? "").split(",").map(Number);
    if (text === null || numbers.length < 3 || !numbers.every(Number.isFinite)) return;
    this.yaw = numbers[0]!;
    this.pitch = clamp(numbers[1]!, -MOST_PITCH, MOST_PITCH);
    this.distance = clamp(numbers[2]!, 0.3, 40);
    this.follows = numbers[3] !== 0;
  }

  /** The text that `read` reads. */
  toString(): string {
    const follows = this.follows ? "" : ",0";
    return `${round(this.yaw, 1)},${round(this.pitch, 1)},${round(this.distance, 2)}${follows}`;
  }

  look(name: CameraName): void {
    [this.yaw, this.pitch] = NAMED_CAMERAS[name];
    this.shift = [0, 0, 0];
  }

  turn(dx: number, dy: number): void {
    this.yaw = (this.yaw - dx * DEGREES_PER_PIXEL) % 360;
    this.pitch = clamp(this.pitch + dy * DEGREES_PER_PIXEL, -MOST_PITCH, MOST_PITCH);
  }

  zoom(factor: number): void {
    this.distance = clamp(this.distance * factor, 0.3, 40);
  }

  /** Move the point that the camera looks at by pixels of a picture with the given height. */
  pan(dx: number, dy: number, height: number, metres: number): void {
    const scale = (this.distance * metres) / height;
    const yaw = (this.yaw * Math.PI) / 180;
    this.shift[0] -= Math.cos(yaw) * dx * scale;
    this.shift[2] += Math.sin(yaw) * dx * scale;
    this.shift[1] += dy * scale;
  }

  /** Let a pointer turn, move and zoom the camera; `changed` runs after each change. Returns the function that ends this. */
  attach(element: HTMLElement, metres: () => number, changed: () => void): () => void {
    const held = new Map<number, [number, number]>();
    const span = () => {
      const [a, b] = [...held.values()] as [[number, number], [number, number]];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    const down = (event: PointerEvent) => {
      held.set(event.pointerId, [event.clientX, event.clientY]);
      element.setPointerCapture(event.pointerId);
    };
    const move = (event: PointerEvent) => {
      const before = held.get(event.pointerId);
      if (before === undefined) return;
      const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
      const apart = held.size === 2 ? span() : 0;
      held.set(event.pointerId, [event.clientX, event.clientY]);
      if (held.size === 2) this.zoom(apart / Math.max(span(), 1));
      else if (event.shiftKey || event.buttons & 6) this.pan(dx, dy, element.clientHeight, metres());
      else this.turn(dx, dy);
      changed();
    };
    const up = (event: PointerEvent) => held.delete(event.pointerId);
    const wheel = (event: WheelEvent) => {
      event.preventDefault();
      this.zoom(Math.exp(clamp(event.deltaY, -200, 200) * 0.0015));
      changed();
    };
    const menu = (event: Event) => event.preventDefault();
    element.addEventListener("pointerdown", down);
    element.addEventListener("pointermove", move);
    element.addEventListener("pointerup", up);
    element.addEventListener("pointercancel", up);
    element.addEventListener("wheel", wheel, { passive: false });
    element.addEventListener("contextmenu", menu);
    return () => {
      element.removeEventListener("pointerdown", down);
      element.removeEventListener("pointermove", move);
      element.removeEventListener("pointerup", up);
      element.removeEventListener("pointercancel", up);
      element.removeEventListener("wheel", wheel);
      element.removeEventListener("contextmenu", menu);
    };
  }
}

const clamp = (value: number, least: number, most: number): number => Math.min(Math.max(value, least), most);
const round = (value: number, digits: number): number => Number(value.toFixed(digits));
