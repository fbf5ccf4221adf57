/* The player: what is chosen, which moment is shown, and the controls. */

const STEPS_PER_SECOND = 6;

function startPlayer(data) {
  const player = document.getElementById("player");
  const find = (name) => player.querySelector(`[data-part="${name}"]`);
  const parts = Object.fromEntries(
    ["method", "setting", "round", "other", "screen", "stage", "panels", "play", "scrub", "count", "speed", "status"].map((n) => [n, find(n)]),
  );
  const toggles = [...player.querySelectorAll("[data-show]")];
  const decoded = new Map();
  const state = { step: 0, playing: false, since: 0, views: [] };

  /** The cell of a method in a setting, by their numbers. */
  const cellAt = (method, setting) => data.cells.find((cell) => cell.method === method && cell.setting === setting);
  /** Its rounds; those of another cell where it has the runs of that one. */
  const roundsOf = (cell) => {
    if (!cell) return [];
    return cell.runsOf === null ? cell.rounds : (cellAt(cell.runsOf, cell.setting)?.rounds ?? []);
  };
  const policyOf = (cell) => (cell.runsOf === null ? cell : cellAt(cell.runsOf, cell.setting));
  const number = (select) => Number(select.value);

  function decode(cell, index) {
    const round = roundsOf(cell)[index];
    if (!decoded.has(round)) decoded.set(round, decodeRound(round, policyOf(cell).world, data.units));
    return decoded.get(round);
  }

  function fill(select, entries, wanted) {
    select.replaceChildren(
      ...entries.map(({ value, text, disabled }) => {
        const option = document.createElement("option");
        option.value = value;
        option.textContent = text;
        option.disabled = Boolean(disabled);
        return option;
      }),
    );
    const allowed = entries.filter((entry) => !entry.disabled);
    const kept = allowed.find((entry) => String(entry.value) === String(wanted)) ?? allowed[0];
    if (kept) select.value = kept.value;
  }

  /** Offer what there is: settings with rounds, methods with rounds in that setting, the others to compare with. */
  function offer() {
    const setting = number(parts.setting);
    const entries = data.methods.map((text, value) => {
      const cell = cellAt(value, setting);
      const disabled = !roundsOf(cell).length;
      return { value, text: disabled ? `${text} (${cell?.status ?? "not asked for"})` : text, disabled };
    });
    fill(parts.method, entries, parts.method.value);
    const rounds = roundsOf(cellAt(number(parts.method), setting)).map((round, value) => {
      return { value, text: `${round.number}: ${round.success === null ? "not enclosed" : `${round.success} steps`}` };
    });
    fill(parts.round, rounds, parts.round.value);
    const others = entries
      .filter((entry) => entry.value !== number(parts.method))
      .map((entry) => {
        const lacks = !entry.disabled && roundsOf(cellAt(entry.value, setting)).length <= number(parts.round);
        return lacks ? { ...entry, text: `${entry.text} (without this round)`, disabled: true } : entry;
      });
    fill(parts.other, [{ value: -1, text: "nobody" }, ...others], parts.other.value || -1);
  }

  /** Show what is chosen, from its end: the moment that decides. */
  function choose() {
    offer();
    stop();
    const methods = [number(parts.method), number(parts.other)].filter((method) => method >= 0);
    state.views = methods.map((method) => makeView(cellAt(method, number(parts.setting)), number(parts.round)));
    parts.stage.replaceChildren(...state.views.map((view) => view.figure));
    parts.panels.replaceChildren(...state.views.map((view) => view.panel));
    parts.screen.classList.toggle("compared", methods.length > 1);
    parts.scrub.max = Math.max(...state.views.map((view) => view.last));
    show(Number(parts.scrub.max));
  }

  function makeView(cell, index) {
    const { world } = policyOf(cell);
    const round = decode(cell, index);
    const copy = (name) => document.getElementById(name).content.firstElementChild.cloneNode(true);
    const [figure, panel] = [copy("view"), copy("panel")];
    const found = [...figure.querySelectorAll("[data-view]"), ...panel.querySelectorAll("[data-view]")];
    const part = (name) => found.find((element) => element.dataset.view === name);
    const method = data.methods[cell.method];
    const policy = policyOf(cell);
    part("name").textContent = method;
    part("canvas").setAttribute("aria-label", `${method}, round ${round.number}, seen from above`);
    const owners = cell.runsOf === null ? "" : `, runs of ${data.methods[cell.runsOf]}`;
    const counted = policy.closure === "all" ? "pursuers and obstacles count" : "only pursuers count";
    const otherwise =
      round.recorded === round.success ? "" : `; when evaluated: ${round.recorded === null ? "not" : `step ${round.recorded}`}`;
    part("about").textContent = `Training seed ${policy.seed}${owners}; ${counted}${otherwise}.`;
    const bars = part("bars");
    const rows = Array.from({ length: world.pursuers + (world.discs ? 1 : 0) }, (_, i) => {
      const bar = copy("bar");
      const obstacles = world.entities - world.pursuers > 1 ? "Obstacles" : "Obstacle";
      bar.querySelector("dt").textContent = i < world.pursuers ? `Pursuer ${i}` : obstacles;
      bar.querySelector("i").style.background = `var(--${entityColour(i, world)})`;
      bars.append(bar);
      return bar;
    });
    return { figure, panel, part, world, round, rows, method, last: round.moments.length - 1 };
  }

  function show(step) {
    state.step = Math.min(Math.max(step, 0), Number(parts.scrub.max));
    parts.scrub.value = state.step;
    parts.count.textContent = `${state.step} / ${parts.scrub.max}`;
    parts.scrub.setAttribute("aria-valuetext", `step ${state.step} of ${parts.scrub.max}`);
    const colour = readColours();
    const shown = Object.fromEntries(toggles.map((toggle) => [toggle.dataset.show, toggle.checked]));
    for (const view of state.views) {
      const at = Math.min(state.step, view.last);
      drawMoment(view.part("canvas"), view.world, view.round, at, shown, colour);
      describe(view, at);
    }
    if (!state.playing) parts.status.textContent = state.views.map(spoken).join(" ");
  }

  const STATES = ["open", "closed", "complete"];

  function describe(view, at) {
    const moment = view.round.moments[at];
    const word = STATES[moment.state];
    view.part("state").textContent = at === view.last && view.round.success === null ? "time is up" : word;
    view.part("state").className = `state ${word}`;
    view.part("step").textContent = `step ${at}`;
    const share = (angle) => angle / (2 * Math.PI);
    const total = moment.angles.reduce((sum, angle) => sum + angle, 0);
    view.part("occupied").textContent = percent(share(total));
    view.rows.forEach((row, i) => {
      const angles = i < view.world.pursuers ? [moment.angles[i]] : moment.angles.slice(view.world.pursuers);
      const value = share(angles.reduce((sum, angle) => sum + angle, 0));
      row.querySelector("i").style.width = `${(100 * value).toFixed(1)}%`;
      row.querySelector("b").textContent = percent(value);
    });
    const closed = moment.state > 0;
    view.part("area").textContent = closed ? moment.area.toPrecision(3) : "unbounded";
    // From a hundred times the limit down to it, by orders of magnitude.
    const full = closed ? 1 - Math.log10(Math.max(moment.area / view.world.limit, 1)) / 2 : 0;
    const gauge = view.part("gauge");
    gauge.style.width = `${(100 * Math.max(full, 0)).toFixed(1)}%`;
    gauge.className = word;
    view.part("limit").textContent = `complete below ${view.world.limit}`;
  }

  function spoken(view) {
    const at = Math.min(state.step, view.last);
    return `${view.method}: step ${at} of ${view.last}, ${view.part("state").textContent}.`;
  }

  function percent(share) {
    return `${Math.round(100 * share)} %`;
  }

  function play() {
    if (state.step >= Number(parts.scrub.max)) show(0);
    state.playing = true;
    state.since = performance.now();
    label();
    requestAnimationFrame(tick);
  }

  function stop() {
    state.playing = false;
    label();
  }

  function toggle() {
    if (state.playing) {
      stop();
      show(state.step);
    } else play();
  }

  function label() {
    parts.play.setAttribute("aria-label", state.playing ? "Pause" : "Play");
    parts.play.classList.toggle("playing", state.playing);
  }

  function tick(now) {
    if (!state.playing) return;
    const due = 1000 / (STEPS_PER_SECOND * Number(parts.speed.value));
    if (now - state.since >= due) {
      // A page that was hidden for long goes on with the next step, not with all those that it missed.
      state.since = now - state.since > 3 * due ? now : state.since + due;
      if (state.step + 1 >= Number(parts.scrub.max)) stop();
      show(state.step + 1);
    }
    requestAnimationFrame(tick);
  }

  function jump(step) {
    stop();
    show(step);
  }

  const ACTIONS = {
    " ": toggle,
    ArrowRight: () => jump(state.step + 1),
    ArrowLeft: () => jump(state.step - 1),
    Home: () => jump(0),
    End: () => jump(Number(parts.scrub.max)),
  };

  player.addEventListener("keydown", (event) => {
    const own = event.target;
    const action = ACTIONS[event.key];
    const taken = own.matches("select") || (event.key === " " && own.matches("button, [type=checkbox]"));
    if (!action || taken || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action();
  });
  player.addEventListener("click", (event) => {
    const button = event.target.closest("[data-jump]");
    if (button) ({ start: ACTIONS.Home, back: ACTIONS.ArrowLeft, on: ACTIONS.ArrowRight, end: ACTIONS.End })[button.dataset.jump]();
  });
  parts.play.addEventListener("click", toggle);
  parts.stage.addEventListener("click", toggle);
  parts.scrub.addEventListener("input", () => jump(Number(parts.scrub.value)));
  for (const select of [parts.method, parts.setting, parts.round, parts.other]) select.addEventListener("change", choose);
  for (const toggle of toggles) toggle.addEventListener("change", () => show(state.step));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => show(state.step));
  new ResizeObserver(() => show(state.step)).observe(parts.stage);

  const settings = data.settings.map((text, value) => {
    const disabled = !data.cells.some((cell) => cell.setting === value && roundsOf(cell).length);
    return { value, text: disabled ? `${text} (not run)` : text, disabled };
  });
  if (settings.every((entry) => entry.disabled)) {
    player.replaceChildren(Object.assign(document.createElement("p"), { textContent: "Not run: there is no round to show." }));
    return;
  }
  fill(parts.setting, settings, data.start.setting);
  fill(parts.method, data.methods.map((text, value) => ({ value, text })), data.start.method);
  choose();
}

startPlayer(JSON.parse(document.getElementById("rounds").textContent));
