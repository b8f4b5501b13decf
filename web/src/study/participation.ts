/** Requests of a participant of a study. The link's secrets stay in this browser, so that a reload continues the study. */
import { type Clip, clipOf } from "../motion/clip";
import { Api, ApiError, loadSkeleton } from "../wire/api";

const CODE = /^mareystudy_([a-z0-9]+)_[a-z0-9]+$/;
const STORE = "marey-study-";
const CURRENT = `${STORE}current`;

export interface Welcome {
  title: string;
  consent_text: string;
  trials: number;
  seconds: number;
}

export interface Participation {
  title: string;
  clips: number;
  trials: number;
  answered: number;
  remaining: number;
  shown: number;
  seconds: number;
  finished: boolean;
}

export interface Trial {
  number: number;
  /** Numbers of the clips, by position on the screen. */
  clips: number[];
  seconds_left: number;
}

export interface TrialStep {
  finished: boolean;
  remaining: number;
  trial: Trial | null;
}

export interface TrialOutcome {
  outcome: "answered" | "timed_out";
  remaining: number;
  finished: boolean;
}

/** What this browser keeps about a link: its code, a random key, and the token after the exchange. */
interface Stored {
  code: string;
  key: string;
  token: string | null;
}

/** One link of a study, in this browser. */
export class StudyLink {
  private constructor(private readonly name: string, private stored: Stored) {}

  /** Return the link of the address, or else the one that this browser used last; null without one. */
  static open(): StudyLink | null {
    const match = CODE.exec(location.hash.slice(1));
    if (match !== null) {
      history.replaceState(null, "", location.pathname + location.search);
      const name = STORE + match[1];
      const known = read(name);
      const stored = known?.code === match[0] ? known : { code: match[0], key: randomKey(), token: null };
      const link = new StudyLink(name, stored);
      link.save();
      localStorage.setItem(CURRENT, name);
      return link;
    }
    const name = localStorage.getItem(CURRENT);
    const stored = name === null ? null : read(name);
    return name === null || stored === null ? null : new StudyLink(name, stored);
  }

  get isExchanged(): boolean {
    return this.stored.token !== null;
  }

  welcome(): Promise<Welcome> {
    return new Api().json("POST", "participation/link", { code: this.stored.code });
  }

  /** Give consent and begin. A repeated exchange with the same key is harmless. */
  async consent(): Promise<void> {
    const { code, key } = this.stored;
    const made = await new Api().json<{ token: string }>("POST", "participation", { code, key, consent: true });
    this.stored = { ...this.stored, token: made.token };
    this.save();
  }

  state(): Promise<Participation> {
    return this.api.json("GET", "participation");
  }

  async clip(number: number): Promise<Clip> {
    const parts = `participation/clips/${number}`;
    const [motion, skeleton] = await Promise.all([
      this.api.document(`${parts}/motion`), loadSkeleton(this.api, `${parts}/hierarchy`, `${parts}/mapping`),
    ]);
    return clipOf(`motion ${number}`, motion, skeleton);
  }

  nextTrial(): Promise<TrialStep> {
    return this.api.json("POST", "participation/trials");
  }

  answer(trial: number, chosen: number[], fps: number): Promise<TrialOutcome> {
    const client_fps = Math.min(Math.max(Math.round(fps * 10) / 10, 0.1), 1000);
    return this.api.json("PUT", `participation/trials/${trial}`, { chosen, client_fps });
  }

  /** Delete all answers on the server, and the secrets in this browser. */
  async withdraw(): Promise<void> {
    try {
      await this.api.json("DELETE", "participation");
    } catch (error) {
      if (!(error instanceof ApiError && error.status === 410)) throw error; // deleted already
    }
    localStorage.removeItem(this.name);
    localStorage.removeItem(CURRENT);
  }

  private get api(): Api {
    return new Api(this.stored.token);
  }

  private save(): void {
    localStorage.setItem(this.name, JSON.stringify(this.stored));
  }
}

function read(name: string): Stored | null {
  const text = localStorage.getItem(name);
  return text === null ? null : (JSON.parse(text) as Stored);
}

function randomKey(): string {
  return Array.from(crypto.getRandomValues(new Uint8Array(32)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}
