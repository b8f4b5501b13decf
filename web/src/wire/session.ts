/** Sign-in of this browser by a link: the code in the fragment of the address is exchanged for a cookie. */
import { Api } from "./api";

const CODE = /^#(mareyview_[a-z0-9]+_[a-z0-9]+)$/;

/** Exchange the code of the address, if there is one, and remove it from the address and the history. */
export async function signIn(): Promise<void> {
  const match = CODE.exec(location.hash);
  if (match === null) return;
  history.replaceState(null, "", location.pathname + location.search);
  await new Api().json("POST", "browser-sessions", { code: match[1] });
}
