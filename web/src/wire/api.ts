/** Requests to the REST API, at the server that this page comes from. */
import { type Clip, clipOf, skeletonOf } from "../motion/clip";
import { type HierarchyDocument, type MappingDocument, Skeleton } from "../motion/skeleton";
import { decodeMessagePack, type Tree } from "./messagepack";

const BLOCKS = "application/msgpack; arrays=blocks";
const RETRIES = 4;
/** Longest wait before a repeated request, in seconds. */
const LONGEST_WAIT_S = 20;

/** Refusal of a request, with the text of the server's problem document. */
export class ApiError extends Error {
  constructor(
    readonly status: number,
    readonly code: string,
    detail: string,
    readonly requestId: string | null,
  ) {
    super(detail);
  }
}

export class Api {
  /** `token` is sent with each request; without it, the browser sends the cookie of its session. */
  constructor(private readonly token: string | null = null) {}

  async json<T>(method: string, path: string, body?: unknown): Promise<T> {
    const answer = await this.send(method, path, "application/json", body);
    return (answer.status === 204 ? null : await answer.json()) as T;
  }

  /** Read a document whose arrays stay in blocks. */
  async document(path: string): Promise<Tree> {
    const answer = await this.send("GET", path, BLOCKS);
    return decodeMessagePack(new Uint8Array(await answer.arrayBuffer()));
  }

  /** Send a request, and repeat it if the server is busy or the network fails. Throws an ApiError if it is refused. */
  private async send(method: string, path: string, accept: string, body?: unknown): Promise<Response> {
    const headers: Record<string, string> = { Accept: accept };
    if (body !== undefined) headers["Content-Type"] = "application/json";
    if (this.token !== null) headers["Authorization"] = `Bearer ${this.token}`;
    const request: RequestInit = { method, headers, credentials: "same-origin" };
    if (body !== undefined) request.body = JSON.stringify(body);
    for (let repeated = 0; ; repeated++) {
      const answer = await fetch(new URL(`api/v1/${path}`, document.baseURI), request).catch(() => null);
      if (answer?.ok) return answer;
      const busy = answer === null || answer.status === 503 || answer.status === 429;
      if (!busy || repeated === RETRIES) throw answer === null ? unreachable() : await problemOf(answer);
      const asked = Number(answer?.headers.get("Retry-After"));
      const wait = asked > 0 ? asked : 2 ** repeated / 2;
      if (wait > LONGEST_WAIT_S) throw answer === null ? unreachable() : await problemOf(answer);
      await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
    }
  }
}

function unreachable(): ApiError {
  return new ApiError(0, "unreachable", "The server does not answer. Check the network, then reload the page.", null);
}

async function problemOf(answer: Response): Promise<ApiError> {
  const problem = (await answer.json().catch(() => ({}))) as { code?: string; detail?: string };
  const detail = problem.detail ?? "The server refused the request and gave no reason.";
  return new ApiError(answer.status, problem.code ?? "", detail, answer.headers.get("X-Request-Id"));
}

/** Address of an item in a link: `project/item`, or `project/item@revision`. */
export interface ItemAddress {
  project: string;
  item: string;
  revision: number | null;
}

/** Read the address of an item. Throws a RangeError for other texts. */
export function parseAddress(text: string): ItemAddress {
  const match = /^([^/@]+)\/([^/@]+)(?:@([1-9]\d{0,8}))?$/.exec(text);
  if (match === null) throw new RangeError(`“${text}” is not the address of an item; write project/item or project/item@revision`);
  return { project: match[1]!, item: match[2]!, revision: match[3] === undefined ? null : Number(match[3]) };
}

/** Load a clip with its skeleton. */
export async function loadClip(api: Api, address: ItemAddress): Promise<Clip> {
  const project = `projects/${encodeURIComponent(address.project)}`;
  const item = `${project}/clips/${encodeURIComponent(address.item)}`;
  const [{ name, collection }, motion] = await Promise.all([
    api.json<{ name: string; collection: string }>("GET", item),
    api.document(`${item}/parts/motion${address.revision === null ? "" : `?revision=${address.revision}`}`),
  ]);
  const reference = skeletonOf(motion);
  const parts = `${project}/skeletons/${encodeURIComponent(reference.item)}/parts`;
  const skeleton = await loadSkeleton(
    api, `${parts}/hierarchy?revision=${reference.revision}`, `${parts}/mapping?revision=${reference.revision}`,
  );
  return clipOf(collection === "" ? name : `${collection}/${name}`, motion, skeleton);
}

/** Load a skeleton; one without a mapping is shown all the same. */
export async function loadSkeleton(api: Api, hierarchy: string, mapping: string): Promise<Skeleton> {
  const [joints, mapped] = await Promise.all([
    api.json<HierarchyDocument>("GET", hierarchy),
    api.json<MappingDocument>("GET", mapping).catch((error: unknown) => {
      if (error instanceof ApiError && error.status === 404) return null;
      throw error;
    }),
  ]);
  return new Skeleton(joints, mapped);
}
