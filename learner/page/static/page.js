"use strict";
// The page asks for what is new every two seconds, and keeps two hours. Names are those of /metrics.
const EVERY_MS = 2000, KEPT_S = 7200, RATE_S = 20, SILENT_S = 30;
const COLOURS = ["#2f6fdb", "#d9480f", "#2b8a3e", "#ae3ec9", "#0c8599", "#e67700", "#c2255c", "#5c7cfa"];
const L = "a2s_learner_", STEPS = `${L}env_steps_total`, RECOVERIES = `${L}recoveries_total`, TARGET = `${L}target_steps`;
const UPDATES = `${L}updates_total`, GRADIENT_STEPS = `${L}gradient_steps_total{network="q"}`;
const OF_POLICY = `${L}gradient_steps_total{network="policy"}`; // off-policy alone
const PARTS = ["environment", "selection", "learner", "network"];
const PANELS = [
  ["Return of an episode", [["training", "episode_return_mean"], ["least", "episode_return_min"],
    ["greatest", "episode_return_max"], ["evaluation", "eval_return_mean"], ["best of K", "eval_best_of_k_return_mean"]]],
  ["Length of an episode, steps", [["length", "episode_length_mean_steps"]]],
  ["Environment steps per second", [["steps/s", "env_steps_total", rate]]],
  ["What the time goes into, share", PARTS.map((part) => [part, `time_share{part="${part}"}`])],
  ["Losses", ["policy", "value", "q"].map((loss) => [loss, `loss{loss="${loss}"}`])],
  ["KL divergence of an update, nats", [["KL", "kl"]]],
  ["Learning rates", ["policy", "value", "q"].map((net) => [net, `learning_rate{network="${net}"}`])],
  ["Temperature and entropy", [["temperature", "temperature"], ["entropy, nats", "entropy"]]],
  ["What Q knows of actions", [["correlation with the advantage", "q_action_correlation"], ["believed", "q_slope"]]],
  ["Replay, transitions", [["rows", "replay_transitions"], ["behind the wanted ratio", "samples_per_insert_error"]]],
];
const runs = [];
let charts = [], drawn = "", axis = "time";

const $ = (id) => document.getElementById(id);
const last = (run, name) => run.series[name]?.at(-1) ?? null;
const nameOf = (run) => run.about.run ?? run.place ?? "run";
const short = (x) => x === null || x === undefined ? "-"
  : Math.abs(x) >= 1000 ? Math.round(x).toLocaleString("en") : Number(x.toPrecision(3)).toString();

function make(tag, text = "", attributes = {}) {
  const made = document.createElement(tag);
  made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

function rate(values, t) { // per second, over the last RATE_S seconds
  let from = 0;
  return values.map((value, i) => {
    while (from < i - 1 && t[i] - t[from] > RATE_S) from += 1;
    const before = values[from], seconds = t[i] - t[from];
    if (value === null || !before || seconds <= 0 || value < before) return null; // 0: a restart
    return (value - before) / seconds;
  });
}

function clock(seconds) {
  const two = (number) => String(Math.floor(number)).padStart(2, "0");
  return `${Math.floor(seconds / 3600)}:${two(seconds / 60 % 60)}:${two(seconds % 60)}`;
}

const stamp = (seconds) => new Date(1000 * seconds).toLocaleString("sv"); // 2026-11-29 22:33:20, as ISO 8601

function times(_, ticks, axisIndex, space, every) { // the day where another one begins
  const [days, parts] = [0, 11].map((from) => ticks.map((t) => stamp(t).slice(from, from ? (every % 60 ? 19 : 16) : 10)));
  return parts.map((part, i) => (days[i] === days[i - 1] ? part : `${part}\n${days[i]}`));
}

function told(show) { // in a legend: the value under the cursor, or the latest
  return (u, value, series, i) => show((i ?? null) === null ? u.data[series].findLast((v) => (v ?? null) !== null) : value);
}

function slots(run) {
  const found = new Set();
  for (const name of Object.keys(run.series)) {
    const slot = /^a2s_learner_actor_up\{slot="(\d+)"\}$/.exec(name);
    if (slot) found.add(Number(slot[1]));
  }
  return [...found].sort((a, b) => a - b);
}

function ofSlot(run, what, slot) { return run.series[`${L}actor_${what}{slot="${slot}"}`] ?? []; }

function merge(told) {
  told.runs.forEach((news, i) => {
    const run = runs[i] ??= { t: [], series: {}, about: {}, up: false };
    const before = run.t.length;
    Object.assign(run, { about: news.about, up: news.up, place: news.place });
    run.t.push(...news.t);
    for (const name of new Set([...Object.keys(run.series), ...Object.keys(news.series)])) {
      const series = run.series[name] ??= Array(before).fill(null);
      series.push(...(news.series[name] ?? Array(news.t.length).fill(null)));
    }
    const old = run.t.findIndex((t) => t >= told.now - KEPT_S);
    if (old > 0) for (const each of [run.t, ...Object.values(run.series)]) each.splice(0, old);
  });
}

function recoveries(run) {
  const count = run.series[RECOVERIES] ?? [];
  const found = [];
  for (let i = 1; i < count.length; i += 1) {
    // No target yet: the learner takes over the count of its earlier starts.
    if (count[i] > count[i - 1] && count[i - 1] !== null && run.series[TARGET]?.[i - 1] !== 0) {
      found.push({ i, number: count[i], r: run.series[`${L}recovery_return`]?.[i], best: run.series[`${L}recovery_best_return`]?.[i] });
    }
  }
  return found;
}

function limit(run) {
  const shares = PARTS.map((part) => [part, last(run, `${L}time_share{part="${part}"}`) ?? 0]);
  const [part, share] = shares.reduce((a, b) => (b[1] > a[1] ? b : a));
  return share > 0 ? `${part}, ${Math.round(100 * share)} %` : "-";
}

function showRuns() {
  $("runs").replaceChildren(...runs.map((run) => {
    const steps = last(run, STEPS) ?? 0, target = last(run, TARGET) ?? 0;
    const perS = rate(run.series[STEPS] ?? [], run.t).at(-1) ?? 0;
    const left = perS > 0 && target > steps ? clock((target - steps) / perS) : "-";
    const card = make("article");
    const { algo, env_id: env, seed } = run.about;
    card.append(make("h2", env ? `${nameOf(run)}: ${algo} on ${env}, seed ${seed}` : nameOf(run)));
    card.append(make("progress", "", { max: Math.max(target, 1), value: Math.min(steps, target), "aria-label": "Steps made" }));
    const list = make("dl");
    const shown = [
      ["Steps", steps, STEPS], ["Of", target, `${L}target_steps`], ["Steps/s", perS], ["Time left", left],
      ["Return", last(run, `${L}episode_return_mean`), `${L}episode_return_mean`],
      ["Evaluation", last(run, `${L}eval_return_mean`), `${L}eval_return_mean`],
      ["Episodes", last(run, `${L}episodes_total`), `${L}episodes_total`],
      OF_POLICY in run.series ? ["Gradient steps", last(run, GRADIENT_STEPS), GRADIENT_STEPS] : ["Updates", last(run, UPDATES), UPDATES],
      ["Version", last(run, `${L}weights_version`), `${L}weights_version`],
      ["Recoveries", last(run, RECOVERIES), RECOVERIES],
      ["Actors", last(run, `${L}actors`), `${L}actors`], ["Limited by", limit(run)],
    ];
    for (const [label, value, name] of shown) {
      const of = make("div");
      const raw = name ? { "data-name": name, "data-value": value ?? "" } : {};
      of.append(make("dt", label), make("dd", typeof value === "string" ? value : short(value), raw));
      list.append(of);
    }
    card.append(list);
    return card;
  }));
}

function stateOf(run, slot) {
  if (!run.up) return "unknown";
  if (!(ofSlot(run, "up", slot).at(-1) ?? 0)) return "gone";
  const silent = run.t.at(-1) - (ofSlot(run, "heard_timestamp_seconds", slot).at(-1) ?? run.t.at(-1));
  return silent > SILENT_S / 3 ? `silent for ${Math.round(silent)} s` : "plays";
}

function showActors() {
  const rows = runs.flatMap((run) => slots(run).map((slot) => {
    const state = stateOf(run, slot), bad = state !== "plays";
    const steps = ofSlot(run, "env_steps", slot);
    const behind = (last(run, `${L}weights_version`) ?? 0) - (ofSlot(run, "weights_version", slot).at(-1) ?? 0);
    const row = make("tr", "", bad ? { class: "bad" } : {});
    const cells = [nameOf(run), `${slot}`, state, short(rate(steps, run.t).at(-1)), short(Math.max(behind, 0)), short(steps.at(-1))];
    row.append(...cells.map((text) => make("td", text)));
    row.children[2].className = bad ? "bad" : "good";
    return row;
  }));
  $("actors").replaceChildren(...rows);
}

function grew(run, name, seconds) {
  const series = run.series[name] ?? [];
  const from = run.t.findIndex((t) => t >= run.t.at(-1) - seconds);
  return (series.at(-1) ?? 0) - (series[from] ?? series.at(-1) ?? 0);
}

function alertsOf(run) {
  const name = nameOf(run);
  if (!run.up) return [`${name}: the learner cannot be reached; it has ended, or was killed`];
  const found = [];
  const spans = run.t.length > 1 && run.t.at(-1) - run.t[0] > 60, done = (last(run, STEPS) ?? 0) >= (last(run, TARGET) ?? Infinity);
  if (spans && !done && grew(run, STEPS, 60) === 0) found.push("the learner gets no environment steps");
  for (const slot of slots(run)) {
    const state = stateOf(run, slot);
    if (state !== "plays" && !done) found.push(`actor ${slot} is ${state}`);
  }
  if (grew(run, `${L}checkpoint_failures_total`, 600) > 0) found.push("a checkpoint could not be written");
  if (grew(run, RECOVERIES, 900) > Math.max(3, grew(run, UPDATES, 900) / 4)) found.push("more than a quarter of all updates are undone by recoveries");
  const stale = grew(run, `${L}transitions_received_total{result="stale"}`, 300);
  const received = ["accepted", "duplicate", "stale", "refused", "unknown"].reduce((sum, v) => sum + grew(run, `${L}transitions_received_total{result="${v}"}`, 300), 0);
  if (received > 0 && stale > 0.1 * received) found.push(`${Math.round(100 * stale / received)} % of the transitions are too old`);
  return found.map((text) => `${name}: ${text}`);
}

function showLists() {
  const alerts = runs.flatMap(alertsOf);
  const items = alerts.map((text) => make("li", text, { class: "bad" }));
  $("alerts").replaceChildren(...(items.length ? items : [make("li", "none", { class: "none" })]));
  const marks = runs.flatMap((run) => recoveries(run).map(({ i, number, r, best }) => make(
    "li", `${nameOf(run)}: number ${number} at ${short(run.series[STEPS]?.[i])} steps, r ${short(r)}, r* ${short(best)}`,
  )));
  $("recoveries").replaceChildren(...(marks.length ? marks : [make("li", "none", { class: "none" })]));
  const down = runs.length > 0 && runs.every((run) => !run.up);
  $("state").className = down ? "bad" : "";
  const live = runs.filter((run) => run.up).length, plural = runs.length > 1 ? "s" : "";
  const some = live === runs.length ? `${live} run${plural}, live` : `${live} of ${runs.length} runs live`;
  $("state").textContent = runs.length === 0 ? "no run" : down ? "no learner answers" : some;
}

function table(run, lines) { // x, and one column a line; over steps a point for each step count
  const x = axis === "time" ? run.t : run.series[STEPS] ?? [];
  const kept = [];
  x.forEach((value, i) => { if (value !== null && (kept.length === 0 || value > x[kept.at(-1)])) kept.push(i); });
  return [kept.map((i) => x[i]), ...lines.map(([, name, of]) => {
    const raw = run.series[L + name] ?? Array(x.length).fill(null);
    const values = of ? of(raw, run.t) : raw;
    return kept.map((i) => values[i] ?? null);
  })];
}

function infoPanels() { // is_success, and each --info-metric
  const names = new Set(runs.flatMap((run) => Object.keys(run.series)));
  const found = [...names].map((name) => /^a2s_learner_(?:episode|eval)_info_mean\{metric="(.*)"\}$/.exec(name)).filter(Boolean);
  return [...new Set(found.map(([, metric]) => metric))].map((metric) => [`${metric}, mean of episodes`, [
    ["training", `episode_info_mean{metric="${metric}"}`], ["evaluation", `eval_info_mean{metric="${metric}"}`],
  ]]);
}

function linesOf([title, lines]) {
  if (title !== "Environment steps per second") return lines;
  const most = Math.max(0, ...runs.map((run) => slots(run).length));
  const each = Array.from({ length: Math.min(most, 16) }, (_, slot) => [`actor ${slot}`, `actor_env_steps{slot="${slot}"}`, rate]);
  return [...lines, ...each];
}

function marked(u) { // a vertical line for every recovery
  const { ctx } = u, { top, height } = u.bbox;
  ctx.save();
  ctx.strokeStyle = "#d6336c";
  ctx.setLineDash([4, 4]);
  for (const run of runs) {
    for (const { i } of recoveries(run)) {
      const x = u.valToPos(axis === "time" ? run.t[i] : run.series[STEPS][i], "x", true);
      ctx.beginPath();
      ctx.moveTo(x, top);
      ctx.lineTo(x, top + height);
      ctx.stroke();
    }
  }
  ctx.restore();
}

function showPanels() {
  const shown = [...PANELS, ...infoPanels()].map((panel) => [panel[0], linesOf(panel)])
    .map(([title, lines]) => [title, lines.filter(([, name]) => runs.some((run) => (run.series[L + name] ?? []).some((v) => v !== null)))])
    .filter(([, lines]) => lines.length > 0);
  const wanted = JSON.stringify([axis, runs.map(nameOf), shown.map(([title, lines]) => [title, lines.map(([label]) => label)])]);
  const data = shown.map(([, lines]) => uPlot.join(runs.map((run) => table(run, lines))));
  if (wanted === drawn) {
    charts.forEach((chart, i) => chart.setData(data[i]));
    return;
  }
  drawn = wanted;
  charts.forEach((chart) => chart.destroy());
  const ink = getComputedStyle(document.body).color, line = getComputedStyle(document.documentElement).getPropertyValue("--line");
  const cards = shown.map(([title]) => {
    const card = make("article");
    card.append(make("h2", title), make("div"));
    return card;
  });
  $("panels").replaceChildren(...cards);
  charts = shown.map(([title, lines], i) => new uPlot({
    width: cards[i].lastChild.clientWidth, height: 230,
    scales: { x: { time: axis === "time" } },
    axes: [
      { stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line }, values: axis === "time" ? times : (_, xs) => xs.map(short), space: 80 },
      { stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line }, size: 64, values: (_, ys) => ys.map(short) },
    ],
    series: [{ label: axis, value: told(axis === "time" ? (t) => (t === undefined ? "-" : stamp(t)) : short) }, ...runs.flatMap((run, r) => lines.map(([label], n) => ({
      label: runs.length > 1 ? `${nameOf(run)}: ${label}` : label, spanGaps: true,
      stroke: COLOURS[(runs.length > 1 ? r : n) % COLOURS.length], dash: runs.length > 1 && n > 0 ? [2 + 2 * n, 3] : undefined,
      width: n > 0 ? 1 : 2, value: told(short),
    })))],
    hooks: i === 0 ? { draw: [marked] } : {},
  }, data[i], cards[i].lastChild));
}

function show() {
  showRuns();
  showActors();
  showLists();
  showPanels();
}

async function poll() {
  try {
    const reply = await fetch(`data?since=${runs.map((run) => run.t.at(-1) ?? 0)}`);
    merge(await reply.json());
  } catch {
    runs.forEach((run) => { run.up = false; }); // whoever serves this page has gone
  }
  show();
  setTimeout(poll, EVERY_MS);
}

for (const choice of document.getElementsByName("axis")) {
  choice.addEventListener("change", () => { axis = choice.value; show(); });
}
const redraw = () => { drawn = ""; showPanels(); };
addEventListener("resize", redraw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
poll();
