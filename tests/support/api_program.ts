// A program that uses the types which openapi-typescript generates from the OpenAPI document. It is only type-checked.

import type { components, paths } from "./api";

type Schemas = components["schemas"];
type Success<Answer> = Answer extends { responses: { 200: { content: { "application/json": infer Found } } } } ? Found : never;
type Get<Path extends keyof paths> = paths[Path] extends { get: infer Operation } ? Success<Operation> : never;
type Post<Path extends keyof paths> = paths[Path] extends { post: infer Operation } ? Success<Operation> : never;

const API = "/api/v1";

async function read<Path extends keyof paths>(path: Path, address: string, token: string): Promise<Get<Path>> {
  const answer = await fetch(address, { headers: { Authorization: `Bearer ${token}`, Accept: "application/json" } });
  if (!answer.ok) {
    const problem: Schemas["Problem"] = await answer.json();
    throw new Error(`${problem.code}: ${problem.detail}`);
  }
  return answer.json();
}

export async function clipNames(token: string): Promise<string[]> {
  const page = await read(`${API}/projects/{project}/{kind}`, `${API}/projects/lab/clips`, token);
  return page.items.map((clip) => clip.name ?? "");
}

export async function frames(token: string, clip: string): Promise<number> {
  const path = `${API}/projects/{project}/{kind}/{item}/parts/{part}` as const;
  const document = await read(path, `${API}/projects/lab/clips/${clip}/parts/motion`, token);
  const motion = document as Schemas["MotionDocument"];
  return motion.poses.shape[0];
}

export async function upload(token: string, files: File[]): Promise<Post<"/api/v1/projects/{project}/imports">["entries"]> {
  const form = new FormData();
  for (const file of files) form.append("files", file);
  const headers = { Authorization: `Bearer ${token}` };
  const answer = await fetch(`${API}/projects/lab/imports`, { method: "POST", headers, body: form });
  const imported: Schemas["ImportAnswer"] = await answer.json();
  return imported.entries;
}

export const job: Schemas["JobCreate"] = { kind: "evaluate" };
export const states: Schemas["JobState"][] = ["queued", "running", "succeeded"];
// @ts-expect-error - `done` is no state of a job
export const unknown: Schemas["JobState"] = "done";

export async function follow(token: string, after: number): Promise<boolean> {
  const feed = await read(`${API}/projects/{project}/events`, `${API}/projects/lab/events?after=${after}`, token);
  return feed.more;
}

export async function log(token: string, id: string): Promise<string> {
  type Log = paths["/api/v1/jobs/{job}/log"]["get"]["responses"][200]["content"]["text/plain"];
  const answer = await fetch(`${API}/jobs/${id}/log`, { headers: { Authorization: `Bearer ${token}` } });
  const text: Log = await answer.text();
  return text;
}
