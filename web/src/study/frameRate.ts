/** Rate of the pictures that a page shows, by which a study decides whether this computer is fast enough. */

/** Least pictures per second of a study: below, people would judge the stutter instead of the motion. */
export const LEAST_RATE = 30;
const KEPT = 90;

export class FrameRate {
  private elapsed: number[] = [];

  note(seconds: number): void {
    this.elapsed.push(seconds);
    if (this.elapsed.length > KEPT) this.elapsed.shift();
  }

  restart(): void {
    this.elapsed = [];
  }

  /** Total time of the pictures that were noted, in seconds. */
  get measured(): number {
    return this.elapsed.reduce((sum, one) => sum + one, 0);
  }

  /** Pictures per second: the median, so that one long pause does not count. */
  get rate(): number {
    if (this.elapsed.length === 0) return 0;
    const sorted = [...this.elapsed].sort((a, b) => a - b);
    return 1 / Math.max(sorted[Math.floor(sorted.length / 2)]!, 1e-4);
  }
}
