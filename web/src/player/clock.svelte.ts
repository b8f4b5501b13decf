/** Clock that all characters of a page share. */

export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
/** Longest time that passes at once, in seconds: after a pause of the page, the clips go on from where they were. */
export const LONGEST_STEP_S = 0.25;

export class Clock {
  /** Time in seconds since the start of the clips. */
  seconds = $state(0);
  playing = $state(false);
  speed = $state(1);
  duration = $state(1);

  /** Let time pass; at the end, the clips begin again. */
  advance(elapsed: number): void {
    if (this.playing) this.seconds = (this.seconds + Math.min(elapsed, LONGEST_STEP_S) * this.speed) % this.duration;
  }

  seek(seconds: number): void {
    this.seconds = Math.min(Math.max(seconds, 0), this.duration);
  }

  /** Choose the next slower (-1) or faster (1) speed. */
  shiftSpeed(step: -1 | 1): void {
    const index = SPEEDS.indexOf(this.speed) + step;
    this.speed = SPEEDS[Math.min(Math.max(index, 0), SPEEDS.length - 1)]!;
  }
}
