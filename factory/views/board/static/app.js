// Which page is shown, what keys do, and when numbers are asked for again.

import { ask, clock, h, still } from "./dom.js";
import { failedPage } from "./failed.js";
import { galleryPage } from "./gallery.js";
import { overviewPage } from "./overview.js";
import { samplePage } from "./sample.js";

const LIVE_MS = 5000;
const STILL_MS = 60000;
const main = document.getElementById("main");
let asked = 0; // the newest question; answers to older ones are dropped
let seen = "";

async function show({ quiet = false } = {}) {
  const mine = ++asked;
  const [path, query = ""] = location.hash.replace(/^#\/?/, "").split("?");
  const [view, id] = path.split("/");
  const name = { "": "overview", sample: "gallery" }[view] ?? view;
  document.querySelectorAll("nav a[data-view]").forEach((a) => a.classList.toggle("on", a.dataset.view === name));
  if (!quiet) main.classList.add("waiting");
  let content;
  try {
    if (view === "") content = await overviewPage();
    else if (view === "gallery") content = await galleryPage(query);
    else if (view === "sample") content = await samplePage(encodeURIComponent(id ?? ""));
    else if (view === "failed") content = await failedPage(query);
    else throw new Error(`there is no page ${path}`);
  } catch (error) {
    content = [h("section", { class: "error" }, h("h2", null, "This cannot be shown"), h("p", null, error.message), h("p", null, h("a", { href: "#/" }, "To the overview")))];
  }
  if (mine !== asked) return;
  const open = [...main.querySelectorAll("details[open]")].map((d) => d.dataset.fold);
  main.replaceChildren(...content.filter(Boolean));
  if (quiet) main.querySelectorAll("details").forEach((d) => (d.open = open.includes(d.dataset.fold)));
  else scrollTo(0, 0);
  main.classList.remove("waiting");
  main.dataset.ready = location.hash || "#/";
}

async function watch() {
  let wait = LIVE_MS;
  try {
    const o = await ask("/api/overview");
    const pill = document.getElementById("state");
    pill.textContent = o.state.word;
    pill.className = `pill ${o.state.tone}`;
    pill.title = o.state.last_commit_ms ? `last commit ${clock(o.state.last_commit_ms)}` : "";
    document.title = `${o.where.split("/").pop()}: ${o.state.word}`;
    if (!o.state.live) wait = STILL_MS;
    const changed = o.version !== seen;
    const atTop = /^(#\/?)?$/.test(location.hash);
    if (atTop && seen && (changed || o.state.live) && !document.hidden) await show({ quiet: true });
    seen = o.version;
  } catch {
    const pill = document.getElementById("state");
    pill.textContent = "no answer";
    pill.className = "pill bad";
  }
  if (!still) setTimeout(watch, wait);
}

const go = (name) => document.querySelector(`[data-go="${name}"]`)?.click();

function choose(step) {
  const cards = [...document.querySelectorAll(".card")];
  const at = cards.indexOf(document.activeElement);
  cards[Math.min(cards.length - 1, Math.max(0, at + step))]?.focus();
}

function toggle() {
  const dark = document.documentElement.dataset.theme
    ? document.documentElement.dataset.theme === "dark"
    : matchMedia("(prefers-color-scheme: dark)").matches;
  document.documentElement.dataset.theme = dark ? "light" : "dark";
  if (!still) localStorage.setItem("theme", document.documentElement.dataset.theme);
}

const KEYS = {
  1: () => (location.hash = "#/"),
  2: () => (location.hash = "#/gallery"),
  3: () => (location.hash = "#/failed"),
  ArrowLeft: () => go("back"),
  ArrowRight: () => go("on"),
  ArrowUp: () => choose(-1),
  ArrowDown: () => choose(1),
  " ": () => go("play"),
  Escape: () => history.back(),
  t: toggle,
  "?": () => document.getElementById("keys").showModal(),
};

addEventListener("keydown", (event) => {
  const typing = /^(INPUT|SELECT|TEXTAREA|BUTTON)$/.test(event.target.tagName);
  if (typing || event.ctrlKey || event.metaKey || event.altKey || document.getElementById("keys").open) return;
  const scrolls = event.key === "ArrowUp" || event.key === "ArrowDown" ? !document.querySelector(".cards") || /^(#\/?)?$/.test(location.hash) : false;
  if (!(event.key in KEYS) || scrolls || (event.key === " " && !document.querySelector('[data-go="play"]'))) return;
  event.preventDefault();
  KEYS[event.key]();
});
addEventListener("hashchange", () => show());
document.getElementById("theme").addEventListener("click", toggle);
document.getElementById("help").addEventListener("click", KEYS["?"]);
const stored = still ? null : localStorage.getItem("theme"); // a file may have no storage
if (stored === "dark" || stored === "light") document.documentElement.dataset.theme = stored;
show();
watch();
