/** A study as those who carry it out see it: design, progress, participants, differences and the newest analysis. */
import type { Clip } from "../motion/clip";
import { type Api, ApiError, type ItemAddress, loadClip } from "../wire/api";

const AT_ONCE = 6;
const MOST_PAGES_OF_JOBS = 5;
const CONDUCTORS = ["maintainer", "owner"];

export interface StudyItem {
  name: string;
  collection: string;
  revision: number;
}

export interface Design {
  title: string;
  consent_text: string;
  motions: { clip: { item: string; revision: number }; label: string | null }[];
  trials: number;
  seconds: number;
  seed: number;
}

export interface Progress {
  invited: number;
  started: number;
  finished: number;
  withdrawn: number;
  answered: number;
  timeouts: number;
}

export interface StudyParticipant {
  id: string;
  participant: string;
  revision: number;
  state: "invited" | "started" | "finished" | "withdrawn";
  answered: number;
  timeouts: number;
  expires_at: string | null;
}

/** Differences of the motions; tables are in the order of the study's motions, and null marks missing pairs. */
export interface Differences {
  participants: number;
  trials: number;
  shown: number[][];
  chosen: number[][];
  differences: (number | null)[][];
  order: number[] | null;
  noise: number | null;
}

interface Quality {
  rmse: number | null;
  r2: number | null;
  spearman: number | null;
}

export interface Fit {
  shaping: string;
  quality: Quality;
  components: Record<string, Quality>;
  metric: {
    components: {
      measurement: string;
      exponent: number | null;
      constant: number;
      norm: number;
      weights: Record<string, number>;
      share: number;
    }[];
    fit: { left_out_rmse: number | null };
  };
}

/** The part of an analysis that the page shows; the report has the rest. */
export interface Analysis {
  job: string;
  finishedAt: string;
  /** What participants had perceived when the study was analysed; all who may read the project may see it. */
  table: Differences;
  triangles: { checked: number; violated: number };
  fits: Fit[];
  refusals: string[];
  /** Addresses of the files of the result, relative to the root of the server. */
  files: { report: string | null; document: string; fitted: string | null };
}

interface AnalysisDocument extends Omit<Differences, "order" | "noise">, Pick<Analysis, "triangles" | "fits" | "refusals"> {
  order: { order: number[] } | null;
  noise_ceiling: number | null;
}

interface Job {
  id: string;
  finished_at: string;
  inputs: Record<string, { item?: string; revision?: number } | { item?: string; revision?: number }[]>;
  result: Record<string, unknown> | null;
}

/** One revision of a study. */
export class Study {
  private readonly clips = new Map<number, Promise<Clip>>();

  private constructor(
    private readonly api: Api,
    readonly address: ItemAddress,
    readonly item: StudyItem,
    readonly revision: number,
    readonly design: Design,
    /** Whether the caller may see participants and what they answered. */
    readonly isConducted: boolean,
  ) {}

  static async open(api: Api, address: ItemAddress): Promise<Study> {
    const project = `projects/${encodeURIComponent(address.project)}`;
    const path = `${project}/studies/${encodeURIComponent(address.item)}`;
    const [{ role }, item] = await Promise.all([
      api.json<{ role: string | null }>("GET", project), api.json<StudyItem>("GET", path),
    ]);
    const revision = address.revision ?? item.revision;
    const design = await api.json<Design>("GET", `${path}/parts/study?revision=${revision}`);
    return new Study(api, address, item, revision, design, CONDUCTORS.includes(role ?? ""));
  }

  /** Address of the study on the command line. */
  get place(): string {
    const { name, collection } = this.item;
    return `${this.address.project}/${collection === "" ? name : `${collection}/${name}`}`;
  }

  progress(): Promise<Progress> {
    return this.api.json("GET", `${this.path}/progress`);
  }

  async participants(): Promise<StudyParticipant[]> {
    const found: StudyParticipant[] = [];
    let cursor: string | null = null;
    do {
      const query: string = cursor === null ? "" : `&cursor=${encodeURIComponent(cursor)}`;
      const page: { items: StudyParticipant[]; next_cursor: string | null } =
        await this.api.json("GET", `${this.path}/participants?limit=1000${query}`);
      found.push(...page.items);
      cursor = page.next_cursor;
    } while (cursor !== null);
    return found;
  }

  differences(): Promise<Differences> {
    return this.api.json("GET", `${this.path}/differences?revision=${this.revision}`);
  }

  /** Return the newest analysis of this revision; null without one. */
  async analysis(known: Analysis | null): Promise<Analysis | null> {
    const job = await this.newestAnalysis();
    if (job === null || job.result === null) return null;
    if (job.id === known?.job) return known;
    const base = `${this.project}/jobs/${job.id}/files`;
    const address = (name: string) => (job.result![name] ? `api/v1/${base}/${name}` : null);
    const document = await this.api.json<AnalysisDocument>("GET", `${base}/document`);
    const table = { ...document, order: document.order?.order ?? null, noise: document.noise_ceiling };
    return {
      job: job.id, finishedAt: job.finished_at, table,
      triangles: document.triangles, fits: document.fits, refusals: document.refusals,
      files: { report: address("report"), document: `api/v1/${base}/document`, fitted: address("fitted") },
    };
  }

  /** Load the poses of a motion once. */
  clip(number: number): Promise<Clip> {
    const { item, revision } = this.design.motions[number]!.clip;
    const known = this.clips.get(number);
    if (known !== undefined) return known;
    const loading = loadClip(this.api, { project: this.address.project, item, revision });
    this.clips.set(number, loading);
    loading.catch(() => this.clips.delete(number)); // so that it can be tried again
    return loading;
  }

  /** Find the names of the clips, some at a time; `found` runs with each. */
  async findNames(found: (number: number, name: string) => void): Promise<void> {
    const waiting = this.design.motions.keys();
    const work = async () => {
      for (const number of waiting) {
        const { item } = this.design.motions[number]!.clip;
        const clip = await this.api.json<StudyItem>("GET", `${this.project}/clips/${encodeURIComponent(item)}`).catch(nothingIfGone);
        found(number, clip?.name ?? "deleted clip");
      }
    };
    await Promise.all(Array.from({ length: AT_ONCE }, work));
  }

  private get project(): string {
    return `projects/${encodeURIComponent(this.address.project)}`;
  }

  private get path(): string {
    return `${this.project}/studies/${encodeURIComponent(this.address.item)}`;
  }

  private async newestAnalysis(): Promise<Job | null> {
    let cursor: string | null = null;
    for (let page = 0; page < MOST_PAGES_OF_JOBS; page++) {
      const query: string = cursor === null ? "" : `&cursor=${encodeURIComponent(cursor)}`;
      const jobs: { items: Job[]; next_cursor: string | null } =
        await this.api.json("GET", `${this.project}/jobs?kind=analyse_study&state=succeeded&limit=100${query}`);
      const newest = jobs.items.find((job) => [job.inputs["study"]].flat().some((one) => this.isOf(one)));
      if (newest !== undefined) return newest;
      cursor = jobs.next_cursor;
      if (cursor === null) return null;
    }
    return null;
  }

  private isOf(input: { item?: string; revision?: number } | undefined): boolean {
    return input?.item === this.address.item && input.revision === this.revision;
  }
}

function nothingIfGone(error: unknown): null {
  if (error instanceof ApiError && error.status === 404) return null;
  throw error;
}
