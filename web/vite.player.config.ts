/** Build of the page that plays motion without a server: one file, to which the client adds the motion. */
import { svelte } from "@sveltejs/vite-plugin-svelte";
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { defineConfig, type Plugin } from "vite";

const PAGE = "player.html";
const FOLDER = "../server/marey_server/webui";
/** Licences of the libraries, which the build of the other pages has written. */
const LICENCES = `${FOLDER}/assets/licences.md`;

export default defineConfig({
  base: "./",
  plugins: [svelte(), onePage()],
  build: {
    outDir: FOLDER,
    emptyOutDir: false, // the other pages are there
    target: "es2022",
    modulePreload: { polyfill: false },
    cssCodeSplit: false,
    rolldownOptions: { input: PAGE, output: { codeSplitting: false } },
  },
});

/** Put the script and the style into the page, with a policy that allows these alone. */
function onePage(): Plugin {
  return {
    name: "one-page",
    enforce: "post",
    generateBundle: {
      order: "post", // after Vite has replaced its own marks in the script
      handler(_options, bundle) {
        const files = Object.values(bundle);
        const page = files.find((file) => file.type === "asset" && file.fileName === PAGE);
        const scripts = files.filter((file) => file.type === "chunk");
        const styles = files.filter((file) => file.type === "asset").filter((file) => file.fileName.endsWith(".css"));
        if (page?.type !== "asset" || scripts.length !== 1 || styles.length !== 1) {
          this.error(`expected one page, script and style, not ${Object.keys(bundle).join(", ")}`);
        }
        const script = scripts[0]!.code.replaceAll("</script", "<\\/script").replaceAll("<!--", "<\\!--");
        const style = textOf(styles[0]!);
        const policy = [
          "default-src 'none'", `script-src '${digest(script)}'`, `style-src '${digest(style)}'`, "img-src data:",
          "connect-src 'none'", "base-uri 'none'", "form-action 'none'",
        ].join("; ");
        const parts = [
          `<meta http-equiv="Content-Security-Policy" content="${policy}" />`,
          `<!--\n${readFileSync(LICENCES, "utf-8").replaceAll("--", "- -")}\n-->`,
          `<style>${style}</style>`,
          `<script type="module">${script}</script>`,
        ];
        const kept = textOf(page).split("\n").filter((line) => !/<script type="module"|<link rel="stylesheet"/.test(line));
        const charset = kept.findIndex((line) => line.includes("charset"));
        kept.splice(charset + 1, 0, parts[0]!);
        kept.splice(kept.findIndex((line) => line.includes("</head>")), 0, ...parts.slice(1));
        page.source = kept.join("\n");
        for (const file of [...scripts, ...styles]) delete bundle[file.fileName];
        if (script.includes("__VITE_")) this.error("the script has marks that Vite would replace later");
      },
    },
  };
}

function textOf({ source }: { source: string | Uint8Array }): string {
  return typeof source === "string" ? source : new TextDecoder().decode(source);
}

function digest(text: string): string {
  return `sha256-${createHash("sha256").update(text).digest("base64")}`;
}
