/** Files that `python -m tests.support.web_cases` has written. */
import { readFileSync } from "node:fs";
import { join } from "node:path";

const FOLDER = process.env["MAREY_WEB_CASES"] ?? join(import.meta.dirname, "cases");

export function bytesOf(name: string): Uint8Array {
  return new Uint8Array(readFileSync(join(FOLDER, name)));
}

export function jsonOf<T>(name: string): T {
  return JSON.parse(readFileSync(join(FOLDER, name), "utf-8")) as T;
}

export function floatsOf(name: string): Float32Array {
  return new Float32Array(bytesOf(name).slice().buffer);
}

export const INDEX = jsonOf<{ arrays: Record<string, number[]>; clips: string[] }>("index.json");
