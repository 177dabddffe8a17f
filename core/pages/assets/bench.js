// The workbench in the browser: switches without a new page, plots, and the button that keeps an effect.
// The server makes all HTML; without this script every switch is a link.
"use strict";

// ---- Switches -------------------------------------------------------------------------------------------------------

const part = document.getElementById("part");
let underway = null;

// Asks for a state and shows it; a request that is overtaken is broken off. While a slider is moved, the table that it
// stands in stays.
async function show(address, key, remember, moving) {
  if (underway) underway.abort();
  underway = new AbortController();
  const signal = underway.signal;
  part.setAttribute("aria-busy", "true");
  try {
    const answer = await fetch("/refit" + address.search, { signal });
    const text = await answer.text();
    if (signal.aborted) return;
    if (answer.ok) {
      const open = opened();
      const channel = document.getElementById("channel");
      const chosen = channel && channel.dataset.chosen;
      if (moving) replaceAround("#effects", text);
      else part.innerHTML = text;
      reopen(open);
      spectrum(read("residuals"), chosen);
      if (remember) history.pushState(null, "", address.href);
      fillToken();
    } else {
      complain(text);
    }
    if (moving) return;
    const again = key && [...part.querySelectorAll("[data-key]")].find((e) => e.dataset.key === key);
    if (again) again.focus({ preventScroll: true });
  } catch (error) {
    if (error.name !== "AbortError") complain("The server does not answer: is it still running?");
  } finally {
    if (underway && underway.signal === signal) part.removeAttribute("aria-busy");
  }
}

// Replaces everything in the part but the block that holds this element.
function replaceAround(selector, text) {
  const template = document.createElement("template");
  template.innerHTML = text;
  const block = (root) => [...root.children].find((child) => child.querySelector(selector));
  const [old, made] = [block(part), block(template.content)];
  for (const child of [...part.childNodes]) if (child !== old) child.remove();
  const all = [...template.content.childNodes];
  const at = all.indexOf(made);
  old.before(...all.slice(0, at));
  old.after(...all.slice(at + 1));
}

function complain(text) {
  const said = part.querySelector(".said");
  if (said) said.textContent = text;
}

// What a reader has unfolded stays so.
function opened() {
  return [...part.querySelectorAll("details")].map((d) => [d.querySelector("summary").textContent, d.open]);
}

function reopen(before) {
  for (const details of part.querySelectorAll("details")) {
    const own = before.find(([text]) => text === details.querySelector("summary").textContent);
    if (own) details.open = own[1];
  }
}

if (part) {
  part.addEventListener("click", (event) => {
    const link = event.target.closest("a[data-refit]");
    if (!link || event.ctrlKey || event.metaKey || event.shiftKey || event.button !== 0) return;
    event.preventDefault();
    show(new URL(link.href), link.dataset.key, true);
  });
  // A switch answers to the space bar too.
  part.addEventListener("keydown", (event) => {
    const link = event.target.closest("a[role=switch]");
    if (link && event.key === " ") {
      event.preventDefault();
      link.click();
    }
  });
  // A slider answers while it is moved, and is remembered where it is let go.
  for (const type of ["input", "change"]) {
    part.addEventListener(type, (event) => {
      const slider = event.target.closest("input[data-stops]");
      if (!slider) return;
      const value = JSON.parse(slider.dataset.values)[slider.value];
      slider.setAttribute("aria-valuetext", value);
      slider.nextElementSibling.textContent = value;
      const address = JSON.parse(slider.dataset.stops)[slider.value];
      show(new URL(address, location.href), slider.dataset.key, type === "change", type === "input");
    });
  }
  addEventListener("popstate", () => show(new URL(location.href), null, false));
}

// ---- Keep -----------------------------------------------------------------------------------------------------------

// The address printed at the start ends in #token=…, which a browser does not send; it is kept until the tab is closed.
const given = /[#&]token=([0-9a-f]+)/.exec(location.hash);
if (given) {
  sessionStorage.setItem("token", given[1]);
  history.replaceState(null, "", location.pathname + location.search);
}

function fillToken() {
  for (const field of document.querySelectorAll("input.token")) {
    if (!field.value) field.value = sessionStorage.getItem("token") || "";
  }
}

fillToken();

// Asks for a change with the token of a form, and shows what the server says. Gives whether it was done.
async function change(address, form, state, place) {
  const token = form.querySelector(".token").value.trim();
  try {
    const headers = { "content-type": "application/json", "x-dragfree-token": token };
    const answer = await fetch(address, { method: "POST", headers, body: JSON.stringify(state) });
    const text = await answer.text();
    if (answer.ok) {
      sessionStorage.setItem("token", token);
      place.innerHTML = text;
      fillToken();
    } else {
      place.textContent = text;
    }
    return answer.ok;
  } catch {
    place.textContent = "The server does not answer: is it still running?";
    return false;
  }
}

document.addEventListener("submit", async (event) => {
  const form = event.target;
  if (form.id === "keep") {
    event.preventDefault();
    const kept = document.getElementById("kept");
    const state = Object.fromEntries(new URLSearchParams(location.search));
    kept.className = (await change("/keep", form, state, kept)) ? "kept" : "refused";
  } else if (form.classList.contains("start")) {
    event.preventDefault();
    const said = form.querySelector(".started");
    const done = await change("/start", form, { ...form.dataset }, said);
    said.className = done ? "started" : "started refused";
    lookAtJobs();
  }
});

// ---- A formula ------------------------------------------------------------------------------------------------------

const formula = document.getElementById("formula");
if (formula) completed(formula);

// Checks a formula while it is typed, and offers names for the word before the caret.
function completed(form) {
  const field = form.elements.expression;
  const list = document.getElementById("formula-names");
  const said = document.getElementById("formula-said");
  const names = read("names");
  let active = -1;
  let timer = 0;
  let asked = 0;
  const word = () => /[A-Za-z_][A-Za-z0-9_.]*$/.exec(field.value.slice(0, field.selectionStart))?.[0] || "";
  const close = () => {
    list.hidden = true;
    active = -1;
    field.setAttribute("aria-expanded", "false");
    field.removeAttribute("aria-activedescendant");
  };
  const take = (name) => {
    const end = field.selectionStart;
    field.setRangeText(name, end - word().length, end, "end");
    close();
    field.focus();
    check();
  };
  const offer = () => {
    const begun = word().toLowerCase();
    const found = begun ? names.filter((n) => n.name.toLowerCase().includes(begun) && n.name !== begun).slice(0, 8) : [];
    list.replaceChildren(
      ...found.map((n, i) => {
        const option = document.createElement("li");
        option.role = "option";
        option.id = "formula-name-" + i;
        option.dataset.name = n.name;
        option.textContent = n.unit ? n.name + ", " + n.unit : n.name;
        option.addEventListener("mousedown", (event) => {
          event.preventDefault();
          take(n.name);
        });
        return option;
      }),
    );
    close();
    list.hidden = !found.length;
    field.setAttribute("aria-expanded", String(found.length > 0));
  };
  const mark = (to) => {
    const all = [...list.children];
    active = (to + all.length) % all.length;
    all.forEach((option, i) => option.setAttribute("aria-selected", String(i === active)));
    field.setAttribute("aria-activedescendant", all[active].id);
  };
  const check = () => {
    clearTimeout(timer);
    const own = ++asked;
    timer = setTimeout(async () => {
      if (!field.value.trim()) return said.replaceChildren();
      try {
        const answer = await fetch("/formula?" + new URLSearchParams(new FormData(form)));
        const text = await answer.text();
        // One that was overtaken says nothing.
        if (own !== asked) return;
        if (answer.ok) said.innerHTML = text;
        else said.textContent = text;
        fillToken();
      } catch {
        said.textContent = "The server does not answer: is it still running?";
      }
    }, 150);
  };
  field.addEventListener("keydown", (event) => {
    if (list.hidden) return;
    if (event.key === "ArrowDown" || event.key === "ArrowUp") mark(active + (event.key === "ArrowDown" ? 1 : -1));
    else if (event.key === "Enter" && active >= 0) take(list.children[active].dataset.name);
    else if (event.key === "Escape") close();
    else return;
    event.preventDefault();
  });
  field.addEventListener("input", offer);
  field.addEventListener("blur", close);
  form.addEventListener("input", (event) => {
    if (!event.target.classList.contains("token")) check();
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    if (!said.querySelector(".token")) return;
    const typed = Object.fromEntries(new FormData(form));
    const place = document.getElementById("formula-added");
    place.className = (await change("/formula", said, typed, place)) ? "kept" : "refused";
  });
}

// ---- What runs ------------------------------------------------------------------------------------------------------

// Asked for again while somebody looks; a page in the background asks nothing.
const ended = () => document.querySelector("#running [data-ended]")?.dataset.ended;
const before = ended();

async function lookAtJobs() {
  const jobs = document.getElementById("running");
  if (!jobs || document.hidden) return;
  try {
    const answer = await fetch("/running");
    const text = answer.ok ? await answer.text() : "";
    // What a reader has unfolded, or has the focus in, is left alone.
    if (!answer.ok || jobs.dataset.text === text || jobs.contains(document.activeElement)) return;
    jobs.dataset.text = text;
    jobs.innerHTML = text;
    // What a command has made is on the page once it is loaded again.
    if ("reload" in jobs.dataset && ended() !== before) location.reload();
  } catch {
    jobs.textContent = "The server does not answer: is it still running?";
  }
}

if (location.protocol.startsWith("http")) setInterval(lookAtJobs, 2000);

// ---- Plots ----------------------------------------------------------------------------------------------------------

function read(id) {
  const element = document.getElementById(id);
  return element ? JSON.parse(element.textContent) : null;
}

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function axis(more) {
  const line = { stroke: colour("--grid"), width: 1 };
  return { stroke: colour("--text"), grid: line, ticks: line, font: "12px system-ui, sans-serif", ...more };
}

const plots = [];

// Plots follow the width of their place, and the colours of the system.
function drawn(make) {
  const entry = { make, plot: null };
  const draw = () => {
    if (entry.plot) entry.plot.destroy();
    entry.plot = entry.make();
  };
  draw();
  plots.push({ draw, there: () => entry.plot.root.isConnected });
}

let waiting = 0;
const redraw = () => {
  clearTimeout(waiting);
  waiting = setTimeout(() => {
    // Those of a part that was replaced are gone.
    plots.splice(0, plots.length, ...plots.filter((p) => p.there()));
    plots.forEach((p) => p.draw());
  }, 100);
};
addEventListener("resize", redraw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

function width(place) {
  return Math.max(240, Math.min(1100, place.clientWidth));
}

const iso = (time) => new Date(1000 * time).toISOString().slice(0, 10);
const days = (u, times) => times.map(iso);

function trends(data) {
  const shared = uPlot.sync("days");
  for (const place of document.querySelectorAll(".plot[data-series]")) {
    const s = data.series.find((own) => own.name === place.dataset.series);
    const faint = { stroke: "transparent", width: 0, points: { show: false }, class: "faint" };
    const options = () => ({
      width: width(place),
      height: 220,
      padding: [8, 44, 0, 0],
      cursor: { sync: { key: shared.key } },
      legend: { show: true, live: true },
      axes: [axis({ values: days, incrs: [1, 2, 7, 14, 28, 91, 182, 364].map((n) => 86400 * n), space: 90 }), axis({ label: s.unit || "1", size: 74, labelFont: "12px system-ui, sans-serif" })],
      scales: { x: { time: true } },
      series: [
        { label: "day", value: (u, time) => (time == null ? "" : iso(time)) },
        { label: "expected to", ...faint },
        { label: "expected from", ...faint },
        { label: "value + σ", ...faint },
        { label: "value − σ", ...faint },
        {
          label: "value",
          stroke: colour("--c0"),
          width: 1,
          points: { show: true, size: 6, fill: colour("--c0") },
        },
      ],
      bands: [
        { series: [1, 2], fill: colour("--band") },
        { series: [3, 4], fill: colour("--sigma") },
      ],
      hooks: { draw: [(u) => marks(u, data.events)] },
    });
    const rows = [s.time, s.expected_high, s.expected_low, s.high, s.low, s.value];
    drawn(() => {
      const plot = new uPlot(options(), rows, place);
      plot.over.addEventListener("click", () => {
        const day = data.products.find((p) => p[0] === s.time[plot.cursor.idx]);
        if (day) location.href = "/day/" + encodeURIComponent(day[1]);
      });
      return plot;
    });
  }
}

// Events as lines on the time axis.
function marks(u, events) {
  const { ctx } = u;
  ctx.save();
  ctx.strokeStyle = colour("--event");
  ctx.setLineDash([4, 4]);
  for (const [time] of events) {
    const x = Math.round(u.valToPos(time, "x", true));
    if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) continue;
    ctx.beginPath();
    ctx.moveTo(x, u.bbox.top);
    ctx.lineTo(x, u.bbox.top + u.bbox.height);
    ctx.stroke();
  }
  ctx.restore();
}

function spectrum(data, chosen) {
  const place = document.getElementById("spectrum");
  const pick = document.getElementById("channel");
  if (!data || !data.channels.length || !place) return;
  // A channel that a reader has picked stays; otherwise the server says which is shown first.
  if (chosen && data.channels.some((c) => c.name === chosen)) {
    pick.value = chosen;
    pick.dataset.chosen = chosen;
  }
  const short = (x) => (x == null ? "" : x.toExponential(1).replace("e+", "e"));
  const make = () => {
    const c = data.channels.find((own) => own.name === pick.value) || data.channels[0];
    const faint = { stroke: "transparent", width: 0, points: { show: false }, class: "faint" };
    const tick = (u, values) => values.map((v) => (v && Math.log10(v) % 1 === 0 ? short(v) : ""));
    const ticks = axis({ values: tick, label: "Hz", labelFont: "12px system-ui, sans-serif" });
    const solid = { stroke: colour("--c0"), width: 2, points: { show: true, size: 5 } };
    if (c.before) {
      // What effects change is small beside the decades of a spectrum: over the noise it is seen.
      const over = (row) => row.map((x, i) => (x / c.modelled[i]) ** 2);
      const two = (u, v) => (v == null ? "" : v.toFixed(2));
      return new uPlot(
        {
          width: width(place),
          height: 320,
          axes: [ticks, axis({ size: 56 })],
          scales: { x: { time: false, distr: 3 } },
          series: [
            { label: "Hz", value: (u, v) => short(v) },
            { label: "95 % to", ...faint, value: two },
            { label: "95 % from", ...faint, value: two },
            { label: "noise", stroke: colour("--c1"), width: 2, dash: [6, 4], points: { show: false }, value: two },
            { label: "model alone", stroke: colour("--c3"), width: 2, dash: [2, 3], points: { show: false }, value: two },
            { label: "with the effects", ...solid, value: two },
          ],
          bands: [{ series: [1, 2], fill: colour("--band") }],
        },
        [c.hz, over(c.high), over(c.low), c.hz.map(() => 1), over(c.before), over(c.measured)],
        place,
      );
    }
    return new uPlot(
      {
        width: width(place),
        height: 320,
        axes: [ticks, axis({ values: tick, size: 64 })],
        scales: { x: { time: false, distr: 3 }, y: { distr: 3 } },
        series: [
          { label: "Hz", value: (u, v) => short(v) },
          { label: "95 % to", ...faint, value: (u, v) => short(v) },
          { label: "95 % from", ...faint, value: (u, v) => short(v) },
          { label: "noise /√Hz", stroke: colour("--c1"), width: 2, dash: [6, 4], points: { show: false }, value: (u, v) => short(v) },
          { label: "measured /√Hz", ...solid, value: (u, v) => short(v) },
        ],
        bands: [{ series: [1, 2], fill: colour("--band") }],
      },
      [c.hz, c.high, c.low, c.modelled, c.measured],
      place,
    );
  };
  drawn(make);
  pick.addEventListener("change", () => {
    pick.dataset.chosen = pick.value;
    redraw();
  });
  for (const button of document.querySelectorAll("[data-channel]")) {
    button.addEventListener("click", () => {
      pick.value = button.dataset.channel;
      pick.dataset.chosen = pick.value;
      redraw();
      place.scrollIntoView({ behavior: "auto", block: "center" });
    });
  }
}

// Least and greatest residual of each stretch of time, with the lines between which 95 of 100 lie.
function overTime(data) {
  const shared = uPlot.sync("over-time");
  for (const place of document.querySelectorAll("[data-over-time]")) {
    const c = data.channels.find((own) => own.name === place.dataset.overTime);
    if (!c) continue;
    const line = { stroke: colour("--c0"), width: 1, points: { show: false } };
    const options = () => ({
      width: width(place),
      height: 130,
      cursor: { sync: { key: shared.key } },
      legend: { show: false },
      axes: [
        axis({ space: 90, values: (u, all) => all.map((t) => new Date(1000 * t).toISOString().slice(11, 16)) }),
        axis({ size: 50, space: 20, values: (u, all) => all.map((v) => v + " σ") }),
      ],
      scales: { x: { time: true }, y: { range: (u, low, high) => [Math.min(-4, low - 0.5), Math.max(4, high + 0.5)] } },
      series: [
        { label: "time" },
        { label: "greatest", ...line },
        { label: "least", ...line },
      ],
      bands: [{ series: [1, 2], fill: colour("--sigma") }],
      tzDate: (t) => uPlot.tzDate(new Date(1000 * t), "Etc/UTC"),
      hooks: { draw: [bounds] },
    });
    drawn(() => new uPlot(options(), [data.time, c.high, c.low], place));
  }
}

// ±1.96 σ.
function bounds(u) {
  const { ctx } = u;
  ctx.save();
  ctx.strokeStyle = colour("--event");
  ctx.setLineDash([4, 4]);
  for (const sigmas of [-1.96, 1.96]) {
    const y = Math.round(u.valToPos(sigmas, "y", true));
    ctx.beginPath();
    ctx.moveTo(u.bbox.left, y);
    ctx.lineTo(u.bbox.left + u.bbox.width, y);
    ctx.stroke();
  }
  ctx.restore();
}

const trend = read("trend");
if (trend) trends(trend);
spectrum(read("residuals"), null);
const series = read("over-time");
if (series) overTime(series);
