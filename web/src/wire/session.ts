/** Sessions of this browser: a code in the fragment of the address is exchanged for a cookie, which reads one project.
 *
 * Pages cannot read the cookie, so they note in the storage of the browser until when they are signed in; it is no secret.
 */
import { Api, ApiError } from "./api";

const CODE = /^#(mareyview_[a-z0-9]+_[a-z0-9]+)$/;
const NOTE = "marey-session-";

/** Exchange the code of the address, if there is one, and remove it from the address and the history. */
export async function signIn(): Promise<void> {
  const match = CODE.exec(location.hash);
  if (match === null) return;
  history.replaceState(null, "", location.pathname + location.search);
  const made = await new Api().json<{ project: string; expires_at: string }>("POST", "browser-sessions", { code: match[1] });
  localStorage.setItem(NOTE + made.project, made.expires_at);
}

/** Whether this browser has a session in a project, which may have been ended elsewhere. */
export function isSignedIn(project: string): boolean {
  return Date.parse(localStorage.getItem(NOTE + project) ?? "") > Date.now();
}

/** Whether a page failed because this browser may not read the project; for strangers, the server has no projects. */
export function needsLink(failure: Error, project: string | null): boolean {
  if (!(failure instanceof ApiError)) return false;
  return failure.status === 401 || (failure.status === 404 && !(project !== null && isSignedIn(project)));
}

/** End the session in a project on the server, which also deletes the cookie. */
export async function signOut(project: string): Promise<void> {
  await new Api().json("DELETE", `browser-sessions/${encodeURIComponent(project)}`);
  localStorage.removeItem(NOTE + project);
}
