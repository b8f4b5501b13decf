/** Frames of the slider: those of the first clip, which are counted on at its rate until the longest clip has ended. */
import type { Clip } from "../motion/clip";

export class Timeline {
  /** Seconds until the longest clip has ended. */
  readonly duration: number;
  readonly frames: number;
  private readonly rate: number;

  constructor(clips: readonly Pick<Clip, "duration" | "frameRate">[]) {
    this.duration = Math.max(0, ...clips.map((clip) => clip.duration));
    this.rate = clips[0]?.frameRate ?? 1;
    this.frames = Math.max(Math.ceil(this.duration * this.rate - 1e-6), 1);
  }

  /** Return the frame at a time; before the start it is the first, after the end the last. */
  frameAt(seconds: number): number {
    return this.within(Math.floor(seconds * this.rate + 1e-6));
  }

  /** Return the time of a frame in seconds; of the first or the last for frames before or after. */
  secondsAt(frame: number): number {
    return this.within(frame) / this.rate;
  }

  private within(frame: number): number {
    return Math.min(Math.max(frame, 0), this.frames - 1);
  }
}
