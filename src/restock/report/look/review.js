"use strict";
// The review page: shows one event at a time, with a slider over its moment, and takes a person's
// verdict. Names of robots, files and conditions are only ever inserted as text. A verdict counts
// once the server has confirmed that it is on disk.
(() => {
  const page = JSON.parse(document.getElementById("page").textContent);
  const at = (id) => document.getElementById(id);
  const SVG = "http://www.w3.org/2000/svg";
  const PLAY = 3;  // playback speed, in multiples of real time
  const words = (name) => name.replaceAll("_", " ");

  function make(tag, attributes = {}, ...children) {
    const node = tag.startsWith("svg:")
      ? document.createElementNS(SVG, tag.slice(4)) : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (value !== null && value !== undefined) node.setAttribute(name, value);
    }
    node.append(...children.map((child) => child instanceof Node ? child : String(child)));
    return node;
  }
  const say = (text, kind = "") => { at("said").textContent = text; at("said").className = kind; };

  // -- verdicts ------------------------------------------------------------------------------
  const me = (() => {
    const own = crypto.randomUUID().slice(0, 8);
    try {
      return sessionStorage.reviewer ??= own;
    } catch {
      return own;
    }
  })();
  let lines = [];
  const given = [];  // ids of the verdicts given on this page, one list per action, for undo

  function verdictsThatCount() {
    const replaced = new Set(lines.flatMap((line) =>
      line.kind === "applied" ? [] : line.instead_of ?? []));
    return lines.filter((line) => line.kind === "verdict" && line.verdict && !replaced.has(line.id));
  }
  const inStore = () => new Set(lines.flatMap((line) => line.kind === "applied" ? line.ids : []));
  let latest = new Map();  // event -> the verdict that counts
  function updateLatest() {
    latest = new Map(verdictsThatCount().map((entry) => [entry.event, entry]));
  }
  function entry(event, verdict, more = {}) {
    const before = verdictsThatCount().filter((one) => one.event === event.event);
    return {
      kind: "verdict", id: crypto.randomUUID(), by: me, event: event.event,
      episode_id: event.episode_id, condition: event.condition,
      first_step: event.first_step, last_step: event.last_step, start_s: event.start_s, verdict,
      note: at("note").value.trim().slice(0, 2000), at: new Date().toISOString(),
      instead_of: before.map((one) => one.id), ...more,
    };
  }

  async function ask(path, body) {
    const answer = await fetch(path, body === undefined ? {} : {
      method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body),
    }).catch(() => {
      throw new Error("The server does not answer: nothing was saved. Run `restock review` again.");
    });
    const document_ = await answer.json().catch(() => ({ error: `error ${answer.status}` }));
    if (!answer.ok) throw new Error(document_.error);
    return document_;
  }
  function take(state) {
    lines = state.lines;
    updateLatest();
  }
  async function give(entries) {
    take(await ask("verdicts", { entries }));
    given.push(entries.map((one) => one.id));
  }

  // -- the order -----------------------------------------------------------------------------
  const events = page.events;
  const marked = [];  // events that a person marked
  let queue = [], current = null, ends = [0, 0], moment = null, now = 0;
  const ORDERS = {
    doubt: ["most doubtful first", (e) => e.doubt],
    random: ["random: estimates precision", (e) => e.random ?? Infinity],
    time: ["by time", (e) => `${e.source_file} ${e.start_time} ${e.event}`],
  };
  function fillQueue() {
    const [, key] = ORDERS[at("order").value];
    const wanted = ["condition", "robot", "week"].map((name) => [name, at(name).value]);
    queue = events.filter((e) => wanted.every(([name, value]) => !value || e[name] === value));
    if (at("order").value === "random") queue = queue.filter((e) => e.random !== null);
    queue.sort((a, b) => (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : a.doubt - b.doubt));
  }
  const open = (event) => !latest.has(event.event);
  function nextOpen() {
    const place = queue.indexOf(current);
    const rest = [...queue.slice(place + 1), ...queue.slice(0, place + 1)];
    return rest.find(open) ?? null;
  }
  function move(by) {
    const place = queue.indexOf(current) + by;
    if (queue[place]) show(queue[place]);
  }

  // -- precision so far ------------------------------------------------------------------------
  function wilson(right, of, z = 1.959963984540054) {
    const share = right / of, part = 1 + z * z / of;
    const middle = (share + z * z / (2 * of)) / part;
    const half = z * Math.sqrt(share * (1 - share) / of + z * z / (4 * of * of)) / part;
    return [middle - half, middle + half];
  }
  function estimate() {
    const judged = [];  // is the label right? events in random order, up to the first without a verdict
    for (const event of queue) {
      if (open(event)) break;
      judged.push(latest.get(event.event).verdict !== "no");
    }
    const right = judged.filter(Boolean).length;
    const later = queue.filter((e) => !open(e)).length - judged.length;
    const skipped = later > 0 ? ` ${later} after a skipped one are not counted.` : "";
    if (!judged.length) return "Give verdicts in this order: the share of right labels is shown." + skipped;
    const [low, high] = wilson(right, judged.length).map((x) => x.toFixed(2));
    return `${right} of ${judged.length} labels are right: ${(right / judged.length).toFixed(2)}`
      + ` (95 %: ${low} to ${high}), of labels that nobody had judged.${skipped}`;
  }

  // -- one event -------------------------------------------------------------------------------
  const moments = new Map();
  function fetched(event, kind = "moment") {
    const key = `${kind} ${event.event}`;
    if (!moments.has(key)) {
      const found = ask(`${kind}/${events.includes(event) ? event.place : event.from}`);
      found.catch(() => moments.delete(key));
      moments.set(key, found);
      if (moments.size > 40) moments.delete(moments.keys().next().value);
    }
    return moments.get(key);
  }

  let loading = Promise.resolve();  // keys wait for it: no event is judged before it is shown
  function show(event) {
    loading = load(event).catch((error) => say(error.message, "bad"));
    return loading;
  }
  async function load(event) {
    current = event;
    moment = null;
    play(false);
    at("event").hidden = event === null;
    at("done").hidden = event !== null;
    const before = latest.get(event?.event);
    const extent = /^(\d+)\.\.(\d+)$/.exec(before?.verdict ?? "");
    ends = extent ? [Number(extent[1]), Number(extent[2])] : [event?.first_step, event?.last_step];
    at("note").value = before?.note ?? "";
    refresh();
    if (event === null) return;
    at("look").classList.add("waiting");
    try {
      const found = await fetched(event);
      if (current !== event) return;
      moment = found;
      now = Math.max(moment.steps.indexOf(event.first_step), 0);
      draw();
    } catch (error) {
      if (current !== event) return;
      say(error.message, "bad");
      at("map").replaceChildren();
      at("plots").replaceChildren();
    } finally {
      if (current === event) at("look").classList.remove("waiting");
    }
    const following = nextOpen();
    if (following) fetched(following).catch(() => {});
    at("cameras").replaceChildren();
    frames = {};
    if (!moment) return;
    fetched(event, "frames").catch((error) => ({ cameras: {}, notes: [error.message] }))
      .then((seen) => { if (current === event) drawFrames(seen); });
  }
  function drawFrames(seen) {
    frames = seen.cameras;
    at("cameras").replaceChildren(
      ...Object.keys(frames).map((name) => make("figure", {},
        make("img", { alt: `camera ${name}`, "data-camera": name }), make("figcaption", {}, name))),
      ...seen.notes.map((note) => make("p", { class: "note" }, note)));
    tick();
  }
  let frames = {};

  function refresh() {
    const done = queue.filter((e) => !open(e)).length;
    const place = queue.indexOf(current);
    at("progress").textContent =
      `${place < 0 ? "–" : place + 1} of ${queue.length}, ${done} judged`;
    at("estimate").textContent = at("order").value === "random" ? estimate() : "";
    const kept = inStore(), count = verdictsThatCount().filter((one) => !kept.has(one.id)).length;
    at("write").textContent = `Write ${count} into the store`;
    at("write").disabled = count === 0;
    at("undo").disabled = given.length === 0;
    if (current === null) return;
    at("name").textContent = words(current.condition);
    at("kind").textContent = current.marked ? "marked by you"
      : current.labelled ? "is labelled: right?" : "is not labelled: missed?";
    const facts = [
      current.probability === null || current.probability === undefined ? null
        : `probability ${current.probability.toFixed(2)}`,
      current.why && current.why !== "probability" ? `doubt: ${current.why}` : null,
      current.robot || null, current.source_file.split("/").pop(),
      `${current.start_time} UTC`, `steps ${current.first_step} to ${current.last_step}`,
    ];
    at("facts").textContent = facts.filter(Boolean).join(" · ");
    const verdict = latest.get(current.event);
    const mine = verdict?.by === me;
    at("verdict").textContent = verdict
      ? `${mine ? "You" : "Somebody"} said ${verdict.verdict} at ${verdict.at.slice(11, 19)} UTC`
        + (kept.has(verdict.id) ? ", and it is in the store." : ".") : "";
    const edited = ends[0] !== current.first_step || ends[1] !== current.last_step;
    at("yes").querySelector("span").textContent = edited || current.marked
      ? `Yes, ${ends[0]}..${ends[1]}` : "Yes";
  }

  async function judge(verdict, other = null) {
    await loading;
    if (current === null) return;
    const event = current;
    try {
      if (event.marked) {
        if (verdict === "yes") {
          const [first, last] = ends;
          const start = moment.t[moment.steps.indexOf(first)];
          const name = `${event.episode_id}/${first}-${last}/${event.condition}`;
          await give([entry({ ...event, event: name, first_step: first, last_step: last, start_s: start }, "yes")]);
          say(`Marked ${words(event.condition)} for steps ${first} to ${last}.`);
        } else {
          say("The mark was dropped.");
        }
        show(events.find((e) => e.event === event.of) ?? nextOpen());
        return;
      }
      const edited = ends[0] !== event.first_step || ends[1] !== event.last_step;
      const said = verdict === "yes" && edited ? `${ends[0]}..${ends[1]}` : verdict;
      const entries = [entry(event, said)];
      if (other) {
        const name = `${event.episode_id}/${event.first_step}-${event.last_step}/${other}`;
        entries.push(entry({ ...event, event: name, condition: other }, edited ? `${ends[0]}..${ends[1]}` : "yes"));
      }
      await give(entries);
      say(`${words(event.condition)}: ${said}${other ? `, it is ${words(other)}` : ""}.`, "good");
      show(nextOpen());
    } catch (error) {
      say(error.message, "bad");
    }
  }
  async function undo() {
    const ids = given.at(-1);
    if (!ids) return;
    const first = lines.find((line) => line.id === ids[0]);
    if (inStore().has(first.id)) {
      given.pop();
      say("That verdict is in the store already: judge the event again.", "bad");
      show(events.find((e) => e.event === first.event) ?? current);
      return;
    }
    const restored = lines.filter((line) => first.instead_of.includes(line.id));
    try {
      const back = { ...first, id: crypto.randomUUID(), verdict: "", note: "", instead_of: ids, at: new Date().toISOString() };
      const again = restored.filter((line) => line.verdict).map((line) =>
        ({ ...line, id: crypto.randomUUID(), instead_of: [], at: new Date().toISOString() }));
      await give([back, ...again]);
      given.pop();
      given.pop();
      say("Undone.");
      show(events.find((e) => e.event === first.event) ?? current);
    } catch (error) {
      say(error.message, "bad");
    }
  }
  function mark() {
    if (!current || !moment) return;
    const from = current.marked ? current : { ...current };
    pick("Mark which condition?", (name) => {
      const first = moment.steps[Math.max(now - 2, 0)];
      const last = moment.steps[Math.min(now + 2, moment.steps.length - 1)];
      const event = {
        ...from, marked: true, of: from.of ?? from.event, from: from.from ?? from.place, condition: name,
        event: `mark ${crypto.randomUUID()}`, first_step: first, last_step: last,
        labelled: false, probability: null, why: "",
      };
      marked.push(event);
      current = event;
      ends = [first, last];
      at("note").value = "";
      refresh();
      draw();
      say("Drag the ends of the stretch, then press yes; no drops it.");
    });
  }
  function pick(title, then) {
    const names = page.conditions[current.recording].filter((name) => title.startsWith("Mark") || name !== current.condition);
    at("pick-title").textContent = title;
    at("pick-names").replaceChildren(...names.map((name, number) => {
      const button = make("button", { type: "button" }, number < 9 ? `${number + 1}  ` : "", words(name));
      button.addEventListener("click", () => { at("pick").close(); then(name); });
      return button;
    }));
    at("pick").showModal();
  }

  // -- pictures ----------------------------------------------------------------------------------
  const GREY = "#94a3b8", INK = "#0f172a", SOFT = "#475569", TEAL = "#0f766e", RED = "#b91c1c", BLUE = "#2563eb", AMBER = "#b45309";
  const colour = (name) => page.colours[name] ?? TEAL;
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
  let moving = {};  // parts of the map that follow the slider

  function line(points) {  // points: x, y, x, y, …; null makes a gap
    let text = "", pen = "M";
    for (let i = 0; i < points.length; i += 2) {
      if (points[i] === null || points[i + 1] === null) { pen = "M"; continue; }
      text += `${pen}${points[i].toFixed(2)} ${(-points[i + 1]).toFixed(2)}`;
      pen = "L";
    }
    return text;
  }
  const pairs = (low, high) => {
    const found = [];
    for (let i = Math.max(low, 0); i <= Math.min(high, moment.x.length - 1); i++) found.push(moment.x[i], moment.y[i]);
    return found;
  };
  const index = (step) => {
    const found = moment.steps.findIndex((one) => one >= step);
    return found < 0 ? moment.steps.length - 1 : found;
  };
  const stroke = (path, color, width, more = {}) => make("svg:path", {
    d: path, fill: "none", stroke: color, "stroke-width": width, "vector-effect": "non-scaling-stroke",
    "stroke-linecap": "round", "stroke-linejoin": "round", ...more });

  function draw() {
    at("slider").max = moment.steps.length - 1;
    drawMap();
    drawPlots();
    const rule = moment.rule;
    at("rule-doc").textContent = rule.name === current.condition ? rule.doc : "";
    at("rule-sql").textContent = [
      ...Object.entries(rule.let).map(([name, sql]) => `${name} =\n    ${sql.replaceAll("\n", "\n    ")}`),
      `${rule.name} (${rule.timing}) =\n    ${rule.sql.replaceAll("\n", "\n    ")}`,
      rule.probability ? `probability =\n    ${rule.probability.replaceAll("\n", "\n    ")}` : "",
    ].filter(Boolean).join("\n\n");
    at("notes").replaceChildren(...moment.notes.map((note) => make("p", { class: "note" }, note)));
    tick();
  }

  function drawMap() {
    const map = at("map");
    const known = moment.x.flatMap((x, i) => x === null || moment.y[i] === null ? [] : [[x, moment.y[i]]]);
    const xs = known.length ? known.map((p) => p[0]) : [0], ys = known.length ? known.map((p) => p[1]) : [0];
    const middle = [(Math.min(...xs) + Math.max(...xs)) / 2, (Math.min(...ys) + Math.max(...ys)) / 2];
    const box = map.getBoundingClientRect(), ratio = box.width / Math.max(box.height, 1) || 1;
    const high = Math.max(7, Math.max(...ys) - Math.min(...ys) + 4, (Math.max(...xs) - Math.min(...xs) + 4) / ratio);
    const wide = high * ratio;
    map.setAttribute("viewBox", `${middle[0] - wide / 2} ${-middle[1] - high / 2} ${wide} ${high}`);
    let walls = "";
    for (let i = 0; i < moment.walls.length; i += 2) {
      walls += `M${(moment.walls[i] - .05).toFixed(2)} ${(-moment.walls[i + 1] - .05).toFixed(2)}h.1v.1h-.1z`;
    }
    moving = {
      event: stroke("", colour(current.condition), 9, { opacity: .45 }),
      driven: stroke("", TEAL, 3),
      plan: stroke("", BLUE, 2, { "stroke-dasharray": "5 5" }),
      goal: stroke("", BLUE, 2.5),
      scan: stroke("", RED, 3.2),
      robot: make("svg:path", { fill: INK, "fill-opacity": .85, stroke: "#ffffff", "stroke-width": 1, "vector-effect": "non-scaling-stroke" }),
    };
    const metre = 2 ** Math.round(Math.log2(wide / 6));
    const [left, low] = [middle[0] - wide / 2 + wide * .03, -middle[1] + high / 2 - high * .04];
    map.replaceChildren(
      make("svg:path", { d: walls, fill: GREY, "fill-opacity": .8 }),
      stroke(line(moment.way), GREY, 1.5, { "stroke-dasharray": "1 5" }),
      moving.event, moving.plan, moving.driven, moving.scan, moving.goal, moving.robot,
      stroke(`M${left} ${low}h${metre}m0 ${high * .012}v${-high * .024}m${-metre} 0v${high * .024}`, SOFT, 2));
    at("scale").textContent = `bar: ${metre} m`;
  }

  function tickMap() {
    if (!moving.robot) return;
    const x = moment.x[now] ?? 0, y = moment.y[now] ?? 0, yaw = moment.yaw[now] ?? 0;
    const cos = Math.cos(yaw), sin = Math.sin(yaw);
    const place = (ahead, left) => [x + ahead * cos - left * sin, y + ahead * sin + left * cos];
    moving.event.setAttribute("d", line(pairs(index(ends[0]), index(ends[1]))));
    moving.driven.setAttribute("d", line(pairs(0, now)));
    let scan = "";
    const points = moment.scan[now] ?? [];
    for (let i = 0; i < points.length; i += 2) {
      const [px, py] = place(points[i] / 100, points[i + 1] / 100);
      scan += `M${px.toFixed(2)} ${(-py).toFixed(2)}h0`;
    }
    moving.scan.setAttribute("d", scan);
    const number = moment.plan[now];
    const ahead = moment.ahead[now];
    const plan = number !== undefined && number !== null ? moment.plans[number]
      : !moment.plans.length && ahead ? [x, y, ...place(ahead[0] ?? 0, ahead[1] ?? 0), ...place(ahead[2] ?? 0, ahead[3] ?? 0)] : [];
    moving.plan.setAttribute("d", line(plan));
    const goal = moment.goal[now];
    moving.goal.setAttribute("d", goal && goal[0] !== null
      ? `M${goal[0] - .2} ${-goal[1] - .2}l.4 .4m0 -.4l-.4 .4` : "");
    const [long, wide] = moment.body.map((size) => size / 2);
    const outline = [[long, 0], [long * .55, wide], [-long, wide], [-long, -wide], [long * .55, -wide]];
    moving.robot.setAttribute("d", line(outline.flatMap(([a, l]) => place(a, l))) + "Z");
  }

  // Plots over time, one above the other, each with its scale, a cursor and the event's band.
  let cursor = [], bands = [], toX = () => 0, fromX = () => 0;
  const LEFT = 34, RIGHT = 8, TOP = 20;

  function drawPlots() {
    const width = Math.max(at("plots").clientWidth, 240);
    const t0 = moment.t[0], t1 = moment.t.at(-1), span = Math.max(t1 - t0, .001);
    toX = (i) => LEFT + (moment.t[i] - t0) / span * (width - LEFT - RIGHT);
    fromX = (px) => {
      const t = t0 + (px - LEFT) / (width - LEFT - RIGHT) * span;
      let best = 0;
      moment.t.forEach((one, i) => { if (Math.abs(one - t) < Math.abs(moment.t[best] - t)) best = i; });
      return best;
    };
    cursor = [];
    bands = [];
    const panels = [];
    const speeds = Object.entries(moment.speeds), rooms = Object.entries(moment.clearances);
    if (speeds.length) panels.push(panel(width, 110, "speed, m/s", speeds, [TEAL, AMBER, SOFT]));
    if (rooms.length) panels.push(panel(width, 96, "clearance, m", rooms, [BLUE, GREY], [0, null]));
    const probable = Object.entries(moment.probabilities).filter(([name]) => name === current.condition);
    if (probable.length) panels.push(panel(width, 84, "", [["probability", probable[0][1]]], [colour(current.condition)], [0, 1]));
    panels.push(strips(width));
    at("plots").replaceChildren(...panels);
  }

  function frame(width, height, label) {
    const svg = make("svg:svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
    const band = make("svg:rect", { y: TOP - 4, height: height - TOP, fill: colour(current.condition), "fill-opacity": .16 });
    const mark = make("svg:path", { stroke: INK, "stroke-width": 1.5, fill: "none" });
    bands.push(band);
    cursor.push([mark, height]);
    svg.append(band);
    return [svg, mark];
  }
  function text(x, y, said, fill = SOFT, more = {}) {
    return make("svg:text", { x, y, fill, "font-size": 12, ...more }, said);
  }

  function panel(width, height, unit, series, colours, [low, high] = [null, null]) {
    const [svg, mark] = frame(width, height, `${series.map(([name]) => name).join(", ")} ${unit}`);
    const all = series.flatMap(([, values]) => values).filter((value) => value !== null);
    const bottom = low ?? Math.min(0, ...all), top = high ?? Math.max(bottom + .1, ...all);
    const toY = (value) => height - 6 - (value - bottom) / (top - bottom) * (height - TOP - 8);
    for (const value of [bottom, top]) {
      svg.append(make("svg:path", { d: `M${LEFT} ${toY(value)}H${width - RIGHT}`, stroke: "#cbd5e1", "stroke-width": 1 }),
        text(LEFT - 5, toY(value) + 4, Number(value.toFixed(1)), SOFT, { "text-anchor": "end" }));
    }
    let x = LEFT;
    if (unit) { svg.append(text(x, 12, unit)); x += unit.length * 6 + 14; }
    series.forEach(([name, values], number) => {
      let path = "", pen = "M";
      values.forEach((value, i) => {
        if (value === null) { pen = "M"; return; }
        path += `${pen}${toX(i).toFixed(1)} ${toY(value).toFixed(1)}`;
        pen = "L";
      });
      svg.append(make("svg:path", { d: path, fill: "none", stroke: colours[number], "stroke-width": 2, "stroke-linejoin": "round" }),
        text(x, 12, name, colours[number], { "font-weight": 600 }));
      x += name.length * 6.6 + 12;
    });
    svg.append(mark);
    return svg;
  }

  function strips(width) {
    const names = Object.keys(moment.labels).filter((name) => name === current.condition || moment.labels[name].includes(1));
    names.sort((a, b) => (a === current.condition ? -1 : b === current.condition ? 1 : a < b ? -1 : 1));
    const row = 32, height = TOP + names.length * row + 14;
    const [svg, mark] = frame(width, height, "labels");
    svg.classList.add("strips");
    names.forEach((name, number) => {
      const y = TOP + number * row;
      svg.append(text(LEFT, y + 8, words(name), colour(name), { "font-weight": 600 }));
      const held = moment.labels[name];
      held.forEach((value, i) => {
        if (!value || held[i - 1]) return;
        let last = i;
        while (held[last + 1]) last++;
        const half = (toX(1) - toX(0)) / 2 || 3;
        svg.append(make("svg:rect", { x: toX(i) - half, y: y + 12, height: 10, rx: 2,
          width: Math.max(toX(last) - toX(i) + 2 * half, 3), fill: colour(name) }));
      });
    });
    const t = (i) => `${moment.t[i].toFixed(1)} s`;
    svg.append(text(LEFT, height - 1, t(0)), text(width - RIGHT, height - 1, t(moment.t.length - 1), SOFT, { "text-anchor": "end" }), mark);
    for (const end of [0, 1]) {
      svg.append(make("svg:path", { class: "handle", "data-end": end, fill: colour(current.condition), stroke: "#ffffff", "stroke-width": 1.5 }));
    }
    return svg;
  }

  function tick() {
    if (!moment) return;
    at("slider").value = now;
    at("when").textContent = `${moment.t[now].toFixed(1)} s, step ${moment.steps[now]}`;
    tickMap();
    for (const [mark, height] of cursor) mark.setAttribute("d", `M${toX(now).toFixed(1)} ${TOP - 6}V${height - 4}`);
    const [first, last] = ends.map((step) => toX(index(step)));
    const half = (toX(1) - toX(0)) / 2 || 3;
    for (const band of bands) {
      band.setAttribute("x", first - half);
      band.setAttribute("width", Math.max(last - first + 2 * half, 2));
    }
    at("plots").querySelectorAll(".handle").forEach((handle) => {
      const x = handle.dataset.end === "0" ? first - half : last + half;
      const y = TOP - 10;
      handle.setAttribute("d", `M${x - 7} ${y}h14v9l-7 8l-7 -8z`);
    });
    const rule = moment.rule;
    const rows = Object.entries(rule.values).map(([name, values]) => [name, values[now], name in rule.let])
      .concat(Object.entries(rule.constants).map(([name, value]) => [name, value, null]));
    at("rule-values").replaceChildren(...rows.map(([name, value, term]) => make("tr", {},
      make("td", { class: "text" }, name),
      make("td", { class: "number" }, value === null || value === undefined ? "–" : Number(value).toFixed(3)),
      make("td", { class: "text note" }, term === null ? "limit" : term ? "term" : "signal"))));
    at("cameras").querySelectorAll("img").forEach((image) => {
      const own = frames[image.dataset.camera];
      const found = own.filter(([step]) => step <= moment.steps[now]).at(-1) ?? own[0];
      image.src = found[1];
    });
  }
  function go(place) {
    if (!moment) return;
    now = clamp(place, 0, moment.steps.length - 1);
    tick();
  }
  let playing = null;
  function play(on = playing === null) {
    cancelAnimationFrame(playing?.frame);
    playing = null;
    at("play").setAttribute("aria-pressed", on && moment !== null);
    at("play").textContent = on && moment ? "❚❚" : "▶";
    if (!on || !moment) return;
    if (now >= moment.steps.length - 1) now = 0;
    const began = performance.now(), from = moment.t[now];
    playing = {};
    const advance = (stamp) => {
      if (!playing || !moment) return;
      const t = from + Math.max(stamp - began, 0) / 1000 * PLAY;
      let place = now;
      while (place < moment.t.length - 1 && moment.t[place + 1] <= t) place++;
      if (place !== now) go(place);
      if (now >= moment.t.length - 1) { play(false); return; }
      playing.frame = requestAnimationFrame(advance);
    };
    playing.frame = requestAnimationFrame(advance);
  }
  function setEnd(end, step) {
    ends[end] = step;
    if (ends[0] > ends[1]) ends[1 - end] = step;
    refresh();
    tick();
  }

  // A pointer on the plots drags an end of the event if it is near one, or else the slider.
  let dragged = null;
  at("plots").addEventListener("pointerdown", (press) => {
    if (!moment) return;
    const x = press.clientX - at("plots").getBoundingClientRect().left;
    const near = ends.map((step, end) => Math.abs(toX(index(step)) + (end ? 6 : -6) - x));
    const on = press.target.closest(".strips") !== null;
    const end = near[0] < near[1] || (near[0] === near[1] && x < toX(index(ends[0]))) ? 0 : 1;
    dragged = on && near[end] < 24 ? end : "now";
    at("plots").setPointerCapture(press.pointerId);
    drag(press);
  });
  function drag(press) {
    if (dragged === null || !moment) return;
    const place = fromX(press.clientX - at("plots").getBoundingClientRect().left);
    now = place;
    if (dragged === "now") tick();
    else setEnd(dragged, moment.steps[place]);
  }
  at("plots").addEventListener("pointermove", drag);
  for (const over of ["pointerup", "pointercancel"]) at("plots").addEventListener(over, () => { dragged = null; });

  // -- keys and buttons --------------------------------------------------------------------------
  const actions = {
    yes: () => judge("yes"), no: () => judge("no"), next: () => move(1), previous: () => move(-1),
    other: () => current && !current.marked && pick("Which condition is it?", (name) => judge("no", name)),
    undo, mark, play: () => play(), first: () => moment && setEnd(0, moment.steps[now]),
    last: () => moment && setEnd(1, moment.steps[now]), back: () => go(now - 1), on: () => go(now + 1),
    write,
  };
  const KEYS = { y: "yes", n: "no", ArrowRight: "next", ArrowLeft: "previous", c: "other", u: "undo",
    m: "mark", " ": "play", "[": "first", "]": "last", ",": "back", ".": "on" };
  for (const name of ["yes", "no", "next", "previous", "other", "undo", "mark", "play", "first", "last", "write"]) {
    at(name).addEventListener("click", () => actions[name]());
  }
  let queued = Promise.resolve();  // keys are handled one after the other, however fast they come
  addEventListener("keydown", (key) => {
    if (key.ctrlKey || key.metaKey || key.altKey) return;
    if (at("pick").open) {
      const button = at("pick-names").children[Number(key.key) - 1];
      if (button) { key.preventDefault(); button.click(); }
      return;
    }
    if (key.target.matches("textarea, select")) {
      if (key.key === "Escape") key.target.blur();
      return;
    }
    if (key.target.matches("input[type=range]") && key.key.startsWith("Arrow")) return;
    if (key.key === "t") { key.preventDefault(); at("note").focus(); return; }
    if (!(key.key in KEYS)) return;
    key.preventDefault();
    queued = queued.then(() => loading).then(() => actions[KEYS[key.key]]());
  });
  at("slider").addEventListener("input", () => go(Number(at("slider").value)));
  at("note").addEventListener("change", async () => {
    const before = current && latest.get(current.event);
    if (!before || before.note === at("note").value.trim()) return;
    try {
      await give([{ ...entry(current, before.verdict), note: at("note").value.trim() }]);
      say("The note is kept.", "good");
      refresh();
    } catch (error) { say(error.message, "bad"); }
  });
  async function write() {
    try {
      const done = await ask("write", {});
      take(done);
      const held = done.held_back.length ? ` Held back: ${done.held_back.join("; ")}.` : "";
      say(`${done.verdicts} verdicts are in the store${done.version === null ? "" : `, version ${done.version}`}.${held}`, held ? "bad" : "good");
      refresh();
    } catch (error) { say(error.message, "bad"); }
  }

  events.forEach((event, place) => { event.place ??= place; });
  const options = (name, values) => at(name).append(...values.map(([value, said]) => make("option", { value }, said)));
  options("order", Object.entries(ORDERS).map(([name, [said]]) => [name, said]));
  for (const name of ["condition", "robot", "week"]) {
    const values = [...new Set(events.map((event) => event[name]))].filter(Boolean).sort();
    options(name, [["", `every ${name}`], ...values.map((value) => [value, name === "condition" ? words(value) : value])]);
    at(name).closest("label").hidden = values.length < 2;
  }
  for (const name of ["order", "condition", "robot", "week"]) {
    at(name).addEventListener("change", () => { fillQueue(); show(queue.find(open) ?? queue[0] ?? null); });
  }
  at("about").textContent = `${events.length < page.total ? `${events.length} of ${page.total}` : events.length} events of ${page.store}.`;
  addEventListener("resize", () => { if (moment && current) draw(); });

  async function begin() {
    take(await ask("state", {}));
    setInterval(async () => {
      try {
        take(await ask("state", {}));
        refresh();
      } catch (error) { say(error.message, "bad"); }
    }, 3000);
    fillQueue();
    await show(queue.find(open) ?? null);
  }
  begin().catch((error) => say(error.message, "bad"));
  // For tests: what is shown, and a promise that resolves when the last key has been handled.
  window.review = { settled: () => queued.then(() => loading), here: () => current?.event ?? null, moment: () => moment };
})();
