// Bundles the pages' scripts and style into dist/, with the versions and licences of what is in them.
import { build } from "esbuild";
import { readFileSync, writeFileSync } from "node:fs";

const { dependencies } = JSON.parse(readFileSync("package.json", "utf8"));
const options = { bundle: true, minify: true, charset: "ascii", legalComments: "none", target: "es2022", outdir: "dist" };

await build({ ...options, entryPoints: ["src/report.js", "src/canopies.js", "src/index.js"], format: "iife" });
await build({ ...options, entryPoints: ["src/style.css"], loader: { ".png": "empty" } });

const licences = Object.entries(dependencies).map(([name, version]) => {
  const text = readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim();
  return `${name} ${version}\n${"=".repeat(name.length + version.length + 1)}\n\n${text}\n`;
});
writeFileSync("dist/LICENSES.txt", `The scripts and the style in this folder contain these works.\n\n${licences.join("\n\n")}`);
