import { mount } from "svelte";
import App from "./App.svelte";
import "./style.css";
import { applyTheme } from "./theme";

applyTheme();
mount(App, { target: document.body });
