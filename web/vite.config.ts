import { svelte } from "@sveltejs/vite-plugin-svelte";
import { defineConfig } from "vitest/config";

export default defineConfig({
  base: "./", // addresses are relative to <base>, which the server sets: so pages work behind a path prefix
  plugins: [svelte()],
  build: {
    outDir: "../server/marey_server/webui",
    emptyOutDir: true,
    target: "es2022",
    modulePreload: { polyfill: false }, // an inline script, which the content security policy refuses
    assetsInlineLimit: 0,
    license: { fileName: "assets/licences.md" },
  },
  test: {
    projects: [
      { test: { name: "unit", include: ["tests/**/*.test.ts"], environment: "node" } },
      {
        test: {
          name: "browser",
          include: ["browser/**/*.test.ts"],
          environment: "node",
          fileParallelism: false,
          testTimeout: 60_000,
          hookTimeout: 60_000,
        },
      },
    ],
  },
});
