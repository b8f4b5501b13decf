/** Rate of the pictures that a page shows, by which a study decides whether this computer is fast enough. */

/** Least pictures per second of a study: below, people would judge the stutter instead of the motion. */
export const LEAST_RATE = 30;
/** Time for which the rate is measured before the first trial, in seconds. */
const TRIAL_RUN_S = 2;
const KEPT = 90;

export class FrameRate {
  private elapsed: number[] = [];

  /** `given` takes the place of the measured rate, for tests on machines without a graphics processor. */
  constructor(private readonly given: number | null = null) {}

  note(seconds: number): void {
    this.elapsed.push(seconds);
    if (this.elapsed.length > KEPT) this.elapsed.shift();
  }

  restart(): void {
    this.elapsed = [];
  }

  /** Whether enough pictures were noted to judge this computer. */
  get isKnown(): boolean {
    const measured = this.elapsed.reduce((sum, one) => sum + one, 0);
    return this.given !== null || this.elapsed.length === KEPT || measured > TRIAL_RUN_S;
  }

  /** Pictures per second: the median, so that one long pause does not count. */
  get rate(): number {
    if (this.given !== null) return this.given;
    if (this.elapsed.length === 0) return 0;
    const sorted = [...this.elapsed].sort((a, b) => a - b);
    return 1 / Math.max(sorted[Math.floor(sorted.length / 2)]!, 1e-4);
  }
}
