import { mount } from "svelte";
import Offline from "./pages/Offline.svelte";
import "./style.css";

// Not by theme.ts: where a browser gives files no storage, asking for it is an error.
document.documentElement.dataset["theme"] = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
mount(Offline, { target: document.body, props: { data: document.getElementById("motion")?.textContent ?? "" } });
