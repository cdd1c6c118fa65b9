(() => {
  "use strict";

  const root = document.documentElement;
  const charts = [];
  const hidden = new Set(); // places of agents
  const compact = new Intl.NumberFormat("en", { notation: "compact", maximumSignificantDigits: 3 });

  function fail(message) {
    root.dataset.error = message;
    const notice = document.getElementById("failure");
    notice.textContent = `The curves could not be drawn: ${message}`;
    notice.hidden = false;
  }

  function color(name) {
    return getComputedStyle(root).getPropertyValue(name).trim();
  }

  function faint(name) {
    const value = color(name); // #RRGGBB
    return /^#[0-9a-f]{6}$/i.test(value) ? value + "33" : value;
  }

  /** A number with about three digits, and fewer below 1, as in the table. */
  function written(value) {
    const size = Math.abs(value);
    if (size === 0) return "0";
    if (size < 1e-4) return value.toExponential(0);
    if (size < 1) return value.toFixed(1 - Math.floor(Math.log10(size)));
    const digits = Math.max(0, 2 - Math.floor(Math.log10(size)));
    return value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  }

  function tick(value) {
    return value === null ? "" : compact.format(value).replace("K", "k");
  }

  /** The polyline through (xs, ys), as it is drawn, at every place of the grid; null beyond its ends. */
  function sampled(grid, xs, ys, log) {
    const forth = log ? Math.log : (y) => y;
    const back = log ? Math.exp : (y) => y;
    let right = 0;
    return grid.map((x) => {
      if (x < xs[0] || x > xs[xs.length - 1]) return null;
      while (xs[right] < x) right += 1;
      if (xs[right] === x) return ys[right];
      const [before, after] = [ys[right - 1], ys[right]];
      if (before === null || after === null) return null;
      const share = (x - xs[right - 1]) / (xs[right] - xs[right - 1]);
      return back(forth(before) * (1 - share) + forth(after) * share);
    });
  }

  /** uPlot wants one x for all: the union of the agents' own, on which every polyline keeps its shape. */
  function columns(chart) {
    const own = chart.series.flatMap((series) => series.x ?? []);
    const grid = own.length ? [...new Set(own)].sort((a, b) => a - b) : [0, 1];
    const data = [grid];
    for (const { x, y, low, high, level } of chart.series) {
      if (x) for (const values of [y, low, high]) data.push(sampled(grid, x, values, chart.log));
      else data.push(...Array(3).fill(grid.map(() => level)));
    }
    return data;
  }

  function lineOptions(series, grid) {
    const name = `--agent-${series.agent}`;
    const few = series.x && series.x.length <= 40;
    const places = few ? series.x.map((x) => grid.indexOf(x)) : [];
    const edge = { stroke: "transparent", width: 0, pxAlign: 0, points: { show: false } };
    const line = {
      stroke: () => color(name),
      width: 2,
      pxAlign: 0,
      dash: series.x ? [] : [7, 5],
      points: { show: few, size: 5, fill: () => color(name), filter: () => places },
    };
    return [line, edge, { ...edge }];
  }

  function range(chart) {
    return (plot, low, high) => {
      if (low === null) return chart.log ? [0.01, 1] : [0, 1];
      const [min, max] = chart.mark === null ? [low, high] : [Math.min(low, chart.mark), Math.max(high, chart.mark)];
      if (chart.log) return [min / 1.25, max * 1.25];
      return uPlot.rangeNum(min, max === min ? min + 1 : max, 0.06, true);
    };
  }

  /** The decades, and between them 2 and 5 where there are few: uPlot's own would begin at the lowest value. */
  function decades(plot, axis, min, max) {
    const [first, last] = [Math.floor(Math.log10(min)), Math.ceil(Math.log10(max))];
    const parts = last - first > 3 ? [1] : [1, 2, 5];
    const splits = [];
    for (let power = first; power <= last; power += 1) {
      for (const part of parts) splits.push(Number(`${part}e${power}`));
    }
    return splits.filter((split) => split >= min && split <= max);
  }

  function drawMark(chart) {
    return (plot) => {
      if (chart.mark === null) return;
      const { ctx, bbox } = plot;
      const y = Math.round(plot.valToPos(chart.mark, "y", true));
      ctx.save();
      ctx.strokeStyle = color("--mark");
      ctx.lineWidth = uPlot.pxRatio;
      ctx.setLineDash([2 * uPlot.pxRatio, 3 * uPlot.pxRatio]);
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
      ctx.restore();
    };
  }

  function options(chart, data, place, show) {
    const axis = {
      stroke: () => color("--soft"),
      grid: { stroke: () => color("--grid"), width: 1 },
      ticks: { show: false },
      font: "12px system-ui, sans-serif",
      values: (plot, splits) => splits.map(tick),
    };
    const logAxis = chart.log ? { splits: decades, filter: (plot, splits) => splits } : {};
    return {
      width: place.clientWidth,
      height: 260,
      legend: { show: false },
      padding: [10, 12, 0, 0],
      cursor: {
        y: false,
        drag: { x: true, y: false },
        points: { size: (plot, index) => (index % 3 === 1 ? 8 : 0) },
        sync: { key: chart.x, scales: ["x", null] },
      },
      scales: { x: { time: false }, y: { distr: chart.log ? 3 : 1, range: range(chart) } },
      axes: [{ ...axis, space: 60, size: 32 }, { ...axis, size: 52, space: 34, ...logAxis }],
      series: [{}, ...chart.series.flatMap((series) => lineOptions(series, data[0]))],
      bands: chart.series.flatMap((series, index) =>
        series.x ? [{ series: [3 * index + 3, 3 * index + 2], fill: () => faint(`--agent-${series.agent}`) }] : []),
      hooks: { drawAxes: [drawMark(chart)], setCursor: [show] },
    };
  }

  function element(tag, name, text) {
    const made = document.createElement(tag);
    made.className = name;
    made.textContent = text;
    return made;
  }

  /** The agents' names, which are buttons, each with its value at the cursor below it. */
  function readout(card, chart, labels) {
    return chart.series.map(({ agent, level }) => {
      const button = element("button", "", "");
      const name = element("span", "name", labels[agent]);
      const key = element("span", level === undefined ? "key" : "key level", "");
      key.style.background = key.style.borderTopColor = `var(--agent-${agent})`;
      name.prepend(key);
      const [value, band] = [element("span", "value", ""), element("small", "band", "")];
      button.type = "button";
      button.dataset.agent = agent;
      button.setAttribute("aria-pressed", "true");
      button.append(name, value, band);
      button.addEventListener("click", () => toggle(agent));
      card.querySelector(".readout").append(button);
      return { value, band };
    });
  }

  function lastIndex(column) {
    return column.findLastIndex((value) => value !== null);
  }

  /** Write every agent's values at the cursor, or at the ends of the curves where there is none. */
  function shower(card, chart, data, cells) {
    const at = card.querySelector(".at");
    return (plot) => {
      const index = plot.cursor.idx;
      const inside = index !== null && index !== undefined && plot.cursor.left >= 0;
      at.textContent = inside ? `at ${written(data[0][index])} ${chart.x}` : "at the end of each curve";
      cells.forEach(({ value, band }, place) => {
        const [y, low, high] = [1, 2, 3].map((offset) => {
          const column = data[3 * place + offset];
          return column[inside ? index : lastIndex(data[3 * place + 1])] ?? null;
        });
        value.textContent = y === null ? "–" : written(y);
        const spread = low !== null && high !== null && chart.series[place].x;
        band.textContent = spread ? `${written(low)} to ${written(high)}` : "";
      });
    };
  }

  function toggle(agent) {
    if (!hidden.delete(agent)) hidden.add(agent);
    for (const { chart, plot } of charts) {
      plot.batch(() => chart.series.forEach((series, place) => {
        if (series.agent !== agent) return;
        for (const offset of [1, 2, 3]) plot.setSeries(3 * place + offset, { show: !hidden.has(agent) });
      }));
    }
    for (const button of document.querySelectorAll(`.readout [data-agent="${agent}"]`)) {
      button.setAttribute("aria-pressed", String(!hidden.has(agent)));
    }
  }

  function followFinger(plot) {
    const follow = (event) => {
      if (event.pointerType === "mouse") return; // uPlot's own affair
      const box = plot.over.getBoundingClientRect();
      plot.setCursor({ left: event.clientX - box.left, top: event.clientY - box.top });
    };
    for (const name of ["pointerdown", "pointermove"]) plot.over.addEventListener(name, follow);
  }

  function followKeys(card, place, plot) {
    const grid = plot.data[0];
    const stride = Math.max(1, Math.round(grid.length / 60));
    const moves = { ArrowLeft: -stride, ArrowRight: stride, Home: -grid.length, End: grid.length };
    place.tabIndex = 0;
    place.setAttribute("role", "slider"); // what one moves along with the arrow keys
    place.setAttribute("aria-valuemin", grid[0]);
    place.setAttribute("aria-valuemax", grid[grid.length - 1]);
    place.setAttribute("aria-valuenow", grid[grid.length - 1]);
    place.addEventListener("keydown", (event) => {
      const move = moves[event.key];
      if (move === undefined) return;
      event.preventDefault();
      const now = plot.cursor.idx ?? grid.length - 1;
      const next = Math.min(grid.length - 1, Math.max(0, now + move));
      plot.setCursor({ left: plot.valToPos(grid[next], "x"), top: 10 });
      place.setAttribute("aria-valuenow", grid[next]);
      const values = [...card.querySelectorAll(".readout button")].map((button) =>
        `${button.querySelector(".name").textContent} ${button.querySelector(".value").textContent}`);
      place.setAttribute("aria-valuetext", `${card.querySelector(".at").textContent}: ${values.join(", ")}`);
    });
    place.addEventListener("blur", () => plot.setCursor({ left: -10, top: -10 }));
  }

  function draw(chart, labels) {
    const card = document.getElementById(`chart-${chart.key}`);
    const place = card.querySelector(".plot");
    if (!chart.series.length) {
      place.classList.add("empty");
      place.textContent = "No data.";
      return;
    }
    const data = columns(chart);
    const cells = readout(card, chart, labels);
    const show = shower(card, chart, data, cells);
    const plot = new uPlot(options(chart, data, place, show), data, place);
    followFinger(plot);
    followKeys(card, place, plot);
    show(plot);
    new ResizeObserver(() => plot.setSize({ width: place.clientWidth, height: 260 })).observe(place);
    charts.push({ chart, plot });
  }

  function isDark() {
    return (root.dataset.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  }

  function setTheme(name) {
    if (name) root.dataset.theme = name;
    else delete root.dataset.theme;
    themed();
  }

  /** The charts are pictures: they take the page's colours when they are drawn. */
  function themed() {
    document.getElementById("theme").textContent = isDark() ? "Light" : "Dark";
    for (const { plot } of charts) plot.redraw(false);
  }

  function themes() {
    const button = document.getElementById("theme");
    button.hidden = false;
    button.setAttribute("aria-label", "Change between light and dark");
    button.addEventListener("click", () => setTheme(isDark() ? "light" : "dark"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", themed);
    themed();
    let before;
    addEventListener("beforeprint", () => { before = root.dataset.theme; setTheme("light"); });
    addEventListener("afterprint", () => setTheme(before));
  }

  /** Browsers that let no file write to the clipboard get the words selected. */
  async function copy(button) {
    const words = button.parentElement.querySelector("code");
    try {
      await navigator.clipboard.writeText(words.textContent);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(words);
      button.textContent = "Selected";
    }
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  }

  /** Some phones play no video from a data URL, but any plays it from memory. */
  function unpackVideo() {
    const video = document.querySelector("video");
    if (!video) return;
    const bytes = Uint8Array.from(atob(video.src.split(",")[1]), (letter) => letter.charCodeAt(0));
    video.src = URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
  }

  addEventListener("error", (event) => fail(event.message));
  try {
    const { agents, charts: all } = JSON.parse(document.getElementById("data").textContent);
    for (const chart of all) draw(chart, agents);
    themes();
    for (const button of document.querySelectorAll(".copy")) {
      button.hidden = false;
      button.addEventListener("click", () => copy(button));
    }
    for (const hint of document.querySelectorAll(".script-only")) hint.hidden = false;
    unpackVideo();
    root.dataset.charts = String(charts.length);
  } catch (error) {
    fail(error.message);
  }
})();
