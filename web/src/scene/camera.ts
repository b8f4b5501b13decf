/** Camera that orbits a figure, and its text in addresses: yaw and pitch in degrees, distance in body heights. */

/** Angles in degrees from the direction that the body faces to the camera, and above the ground. */
const NAMED_CAMERAS = { front: [0, 8], side: [90, 8], top: [0, 89] } as const;
type CameraName = keyof typeof NAMED_CAMERAS;
const CAMERA_NAMES = Object.keys(NAMED_CAMERAS) as CameraName[];

const MOST_PITCH = 89;
const DEGREES_PER_PIXEL = 0.35;
/** Angle from the direction that a body faces to a camera that sees it from the front left. */
const FRONT_LEFT = 35;

export class OrbitCamera {
  /** Direction from the figure to the camera: degrees about the vertical, 0 for +z. */
  yaw = FRONT_LEFT;
  pitch = 12;
  /** Distance from the figure in units of its height. */
  distance = 3;
  /** Shift of the point that the camera looks at, in metres. */
  shift: [number, number, number] = [0, 0, 0];
  /** Whether the camera moves along with the root of the figure. */
  follows = true;
  /** Name of the view that was chosen; null after a turn. */
  private named: CameraName | null = null;

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

  /** See a body that faces `heading` from its front left. */
  face(heading: number): void {
    this.yaw = wrapped(heading + FRONT_LEFT);
  }

  /** Look from the next of the named views at a body that faces `heading`, in degrees. */
  lookNext(heading: number): void {
    this.named = CAMERA_NAMES[(CAMERA_NAMES.indexOf(this.named!) + 1) % CAMERA_NAMES.length]!;
    const [aside, above] = NAMED_CAMERAS[this.named];
    [this.yaw, this.pitch] = [wrapped(heading + aside), above];
    this.shift = [0, 0, 0];
  }

  /** Turn by a drag of a pointer, in pixels. */
  turn(dx: number, dy: number): void {
    this.named = null;
    this.yaw = wrapped(this.yaw - dx * DEGREES_PER_PIXEL);
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
      if (held.size === 2) {
        this.zoom(apart / Math.max(span(), 1));
        this.pan(dx / 2, dy / 2, element.clientHeight, metres()); // the point between two fingers moves half as far
      } else if (event.shiftKey || event.buttons & 6) this.pan(dx, dy, element.clientHeight, metres());
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
/** Return an angle in degrees as −180 to 180. */
const wrapped = (degrees: number): number => degrees - 360 * Math.round(degrees / 360);
const round = (value: number, digits: number): number => Number(value.toFixed(digits));
