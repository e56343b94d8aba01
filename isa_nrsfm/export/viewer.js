"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const model = JSON.parse(byId("model").textContent);
  const shapes = new Float32Array(bytes(model.shapes)); // mean, then basis shapes
  const edges = new Uint32Array(bytes(model.edges));
  const sides = model.sides; // of the points: 0 middle, 1 left, 2 right; or none
  const alpha = new Float32Array(bytes(model.alpha));
  const poses = new Float32Array(bytes(model.rotations));
  const deviations = new Float32Array(bytes(model.deviations)); // of depths; or none
  const times = new Float64Array(bytes(model.times)); // seconds from the first; or none
  const nPoints = model.points.length;
  const nWeights = model.components.length;
  const nFrames = model.rows.length;
  const size = 3 * nPoints;

  const RANGE = 4; // standard deviations on either side of a slider
  const SWING = { amplitude: 2, seconds: 3 };
  const BAR = 2; // standard deviations on either side of a point
  const EYE = 6; // distance of the viewer, in radii of the mean shape
  const OPENED = Math.PI / 9; // turned to the side at first, so that depth is seen
  const LEVELS = 12; // of depth, far ones drawn first and paler
  const TRUE_SPEED = "true";
  const N_COLOURS = 8; // of the page; more labels go round the circle of hues

  const state = {
    weights: new Float32Array(nWeights),
    frame: -1, // none
    swinging: -1,
    playing: false,
    turn: [1, 0, 0, 0, 1, 0, 0, 0, 1],
    zoom: 1,
  };

  // ---- geometry -------------------------------------------------------------

  function shapeOf(weights) {
    const shape = shapes.slice(0, size);
    weights.forEach((weight, k) => {
      if (!weight) return;
      const start = (k + 1) * size;
      for (let i = 0; i < size; i++) shape[i] += weight * shapes[start + i];
    });
    return shape;
  }

  function product(a, b) {
    const c = [];
    for (let i = 0; i < 3; i++)
      for (let j = 0; j < 3; j++)
        c.push(a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j]);
    return c;
  }

  function turnBy(across, up) {
    const [ca, sa, cu, su] = [Math.cos(across), Math.sin(across), Math.cos(up), Math.sin(up)];
    const aboutY = [ca, 0, sa, 0, 1, 0, -sa, 0, ca];
    const aboutX = [1, 0, 0, 0, cu, -su, 0, su, cu];
    state.turn = product(product(aboutX, aboutY), state.turn);
    redraw();
  }

  function viewMatrix() {
    const posed = byId("pose").checked && state.frame >= 0 && poses.length > 0;
    const pose = posed
      ? poses.subarray(9 * state.frame, 9 * state.frame + 9)
      : [1, 0, 0, 0, 1, 0, 0, 0, 1];
    // Half a turn about the axis to the right, and the mirror image in depth.
    const over = byId("over").checked ? -1 : 1;
    const depth = byId("mirror").checked ? -over : over;
    return product(product(state.turn, [1, 0, 0, 0, over, 0, 0, 0, depth]), pose);
  }

  // Positions x, y on the canvas and depth, nearer ones larger, of all points.
  function project(shape) {
    const v = viewMatrix();
    const { clientWidth: width, clientHeight: height } = scene;
    const scale = 0.44 * Math.min(width, height) * state.zoom;
    const seen = new Float32Array(size);
    for (let i = 0; i < size; i += 3) {
      const [x, y, z] = [shape[i], shape[i + 1], shape[i + 2]];
      const depth = v[6] * x + v[7] * y + v[8] * z;
      const s = (scale * EYE) / Math.max(EYE - depth, 0.5);
      seen[i] = width / 2 + s * (v[0] * x + v[1] * y + v[2] * z);
      seen[i + 1] = height / 2 - s * (v[3] * x + v[4] * y + v[5] * z);
      seen[i + 2] = depth;
    }
    return seen;
  }

  // ---- drawing --------------------------------------------------------------

  const scene = byId("scene");
  const plane = byId("plane");
  let latest = null; // positions of the points drawn last
  let pending = false;

  function redraw() {
    if (pending) return;
    pending = true;
    requestAnimationFrame(() => {
      pending = false;
      drawScene();
      if (nFrames) drawPlane();
    });
  }

  function colour(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  }

  function labelColour(code) {
    if (model.categories.length <= N_COLOURS) return colour(`--label-${code}`);
    return `hsl(${(137.5 * code) % 360} 65% 55%)`;
  }

  function cleared(canvas) {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    return pen;
  }

  // The side of an edge is that of its ends; from side to side it is in the middle.
  function sideOf(a, b = a) {
    const [one, other] = [sides[a] || 0, sides[b] || 0];
    return one && other && one !== other ? 0 : one || other;
  }

  // Inks are those of the middle, the left and the right, or one for all.
  function drawShape(pen, seen, inks, faint) {
    const level = (depth) =>
      Math.min(LEVELS - 1, Math.max(0, Math.floor((LEVELS * (depth + 1)) / 2)));
    const kinds = inks.length;
    const levels = Array.from({ length: LEVELS * kinds }, () => ({ points: [], edges: [] }));
    const group = (depth, side) => levels[level(depth) * kinds + (side % kinds)];
    for (let i = 0; i < size; i += 3) group(seen[i + 2], sideOf(i / 3)).points.push(i);
    for (let e = 0; e < edges.length; e += 2) {
      const [a, b] = [3 * edges[e], 3 * edges[e + 1]];
      group((seen[a + 2] + seen[b + 2]) / 2, sideOf(edges[e], edges[e + 1])).edges.push([a, b]);
    }
    const usual = nPoints <= 100 ? 3.2 : nPoints <= 400 ? 2.2 : 0.9;
    const radius = (edges.length ? 0.75 : 1) * usual * Math.sqrt(state.zoom);
    pen.lineWidth = nPoints <= 400 ? 1.6 : 0.7;
    levels.forEach((content, number) => {
      const depth = Math.floor(number / kinds);
      pen.strokeStyle = pen.fillStyle = inks[number % kinds];
      pen.globalAlpha = faint * (0.35 + (0.65 * depth) / (LEVELS - 1));
      pen.beginPath();
      for (const [a, b] of content.edges) {
        pen.moveTo(seen[a], seen[a + 1]);
        pen.lineTo(seen[b], seen[b + 1]);
      }
      pen.stroke();
      pen.beginPath();
      for (const i of content.points) {
        const [x, y] = [seen[i], seen[i + 1]];
        if (nPoints > 400) pen.rect(x - radius, y - radius, 2 * radius, 2 * radius);
        else {
          pen.moveTo(x + radius, y);
          pen.arc(x, y, radius, 0, 7);
        }
      }
      pen.fill();
    });
    pen.globalAlpha = 1;
  }

  // Ends of the error bars of a frame, along the viewing direction of its camera.
  function endsOfBars(shape) {
    const axis = poses.subarray(9 * state.frame + 6, 9 * state.frame + 9);
    const own = deviations.subarray(nPoints * state.frame);
    const end = (length) =>
      project(shape.map((x, i) => x + length * own[Math.floor(i / 3)] * axis[i % 3]));
    return [end(-BAR), end(BAR)];
  }

  function drawBars(pen, [far, near]) {
    pen.strokeStyle = colour("--focus");
    pen.lineWidth = nPoints <= 400 ? 3.5 : 1;
    pen.globalAlpha = 0.75;
    pen.beginPath();
    for (let i = 0; i < size; i += 3) {
      pen.moveTo(far[i], far[i + 1]);
      pen.lineTo(near[i], near[i + 1]);
    }
    pen.stroke();
    pen.globalAlpha = 1;
  }

  function drawScene() {
    const pen = cleared(scene);
    if (byId("ghost").checked) drawShape(pen, project(shapes), [colour("--mean")], 0.7);
    const code = state.frame >= 0 && model.labels.length ? model.labels[state.frame] : -1;
    const shape = shapeOf(state.weights);
    latest = project(shape);
    const inks = [code < 0 ? colour("--shape") : labelColour(code)];
    if (sides.length) inks.push(colour("--left"), colour("--right"));
    if (deviations.length && state.frame >= 0 && byId("bars").checked)
      drawBars(pen, endsOfBars(shape));
    drawShape(pen, latest, inks, 1);
    const row = state.frame < 0 ? "" : `row ${model.rows[state.frame]}`;
    byId("seen").textContent = code < 0 ? row : `${row}: ${model.categories[code]}`;
  }

  // Where the plane of coefficients shows a frame; option -1 is the order of the rows.
  function planePositions() {
    const axis = (select, length, flip) => {
      const k = Number(select.value);
      const value = (i) => (k < 0 ? i : alpha[i * nWeights + k]);
      let [low, high] = [Infinity, -Infinity];
      for (let i = 0; i < nFrames; i++) {
        low = Math.min(low, value(i));
        high = Math.max(high, value(i));
      }
      const scale = (length - 20) / (high - low || 1);
      return (number) => (flip ? length - 10 - scale * (number - low) : 10 + scale * (number - low));
    };
    const x = axis(byId("across"), plane.clientWidth, false);
    const y = axis(byId("upwards"), plane.clientHeight, true);
    const [kx, ky] = [Number(byId("across").value), Number(byId("upwards").value)];
    const of = (weights, i, k) => (k < 0 ? i : weights[k]);
    return (weights, i) => [x(of(weights, i, kx)), y(of(weights, i, ky))];
  }

  const coefficients = (i) => alpha.subarray(i * nWeights, (i + 1) * nWeights);

  function drawPlane() {
    const pen = cleared(plane);
    const position = planePositions();
    const colours = model.categories.map((_, code) => labelColour(code));
    const single = colour("--shape");
    const radius = nFrames > 400 ? 1.6 : 2.4;
    pen.globalAlpha = 0.7;
    for (let i = 0; i < nFrames; i++) {
      const [x, y] = position(coefficients(i), i);
      pen.fillStyle = colours.length ? colours[model.labels[i]] : single;
      pen.fillRect(x - radius, y - radius, 2 * radius, 2 * radius);
    }
    pen.globalAlpha = 1;
    const [x, y] = position(state.weights, Math.max(state.frame, 0));
    pen.strokeStyle = colour("--ink");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(x, y, 6, 0, 7);
    pen.stroke();
  }

  // ---- weights --------------------------------------------------------------

  const sliders = [];
  model.components.forEach((name, k) => {
    const row = document.createElement("div");
    row.className = "weight";
    const label = document.createElement("label");
    label.textContent = name;
    label.htmlFor = `weight-${k}`;
    const slider = Object.assign(document.createElement("input"), {
      type: "range", id: label.htmlFor, min: -RANGE, max: RANGE, step: 0.01, value: 0,
    });
    const value = document.createElement("output");
    value.htmlFor = label.htmlFor;
    const swing = Object.assign(document.createElement("button"), {
      type: "button", textContent: "\u223f", title: `Swing ${name}`,
    });
    swing.setAttribute("aria-label", `Swing ${name}`);
    slider.addEventListener("input", () => {
      stop();
      leaveFrame();
      state.weights[k] = Number(slider.value);
      showWeights();
    });
    swing.addEventListener("click", () => {
      const again = state.swinging === k;
      stop();
      leaveFrame();
      setWeights(new Float32Array(nWeights));
      if (!again) start({ swinging: k });
    });
    row.append(label, slider, value, swing);
    byId("weights").append(row);
    sliders.push({ slider, value, swing });
  });

  function showWeights() {
    sliders.forEach(({ slider, value }, k) => {
      if (Number(slider.value) !== state.weights[k]) slider.value = state.weights[k];
      value.textContent = state.weights[k].toFixed(2).replace("-", "\u2212");
    });
    redraw();
  }

  function setWeights(weights) {
    state.weights.set(weights);
    showWeights();
  }

  // ---- frames and motion ----------------------------------------------------

  function showFrame(i) {
    state.frame = i;
    byId("frame").value = i;
    setWeights(coefficients(i));
  }

  function leaveFrame() {
    state.frame = -1;
  }

  function frameAfter(first, seconds) {
    const pace = byId("pace").value;
    if (pace !== TRUE_SPEED) return (first + Math.floor(seconds * Number(pace))) % nFrames;
    // The last frame that has been taken by then; after the last one from the start.
    const time = (times[first] + seconds) % (times[nFrames - 1] || 1);
    let [low, high] = [0, nFrames - 1];
    while (low < high) {
      const middle = Math.ceil((low + high) / 2);
      if (times[middle] <= time) low = middle;
      else high = middle - 1;
    }
    return low;
  }

  function start(what) {
    Object.assign(state, what);
    showButtons();
    const begun = performance.now();
    const first = state.frame;
    const step = (now) => {
      if (state.swinging >= 0) {
        const phase = (2 * Math.PI * (now - begun)) / (1000 * SWING.seconds);
        state.weights[state.swinging] = SWING.amplitude * Math.sin(phase);
        showWeights();
      } else if (state.playing) {
        const next = frameAfter(Math.max(first, 0), (now - begun) / 1000);
        if (next !== state.frame) showFrame(next);
      } else return;
      state.motion = requestAnimationFrame(step);
    };
    state.motion = requestAnimationFrame(step);
  }

  function stop() {
    cancelAnimationFrame(state.motion);
    Object.assign(state, { swinging: -1, playing: false });
    showButtons();
  }

  function showButtons() {
    sliders.forEach(({ swing }, k) => swing.setAttribute("aria-pressed", state.swinging === k));
    byId("play").setAttribute("aria-pressed", state.playing);
    byId("play").textContent = state.playing ? "Pause" : "Play";
  }

  byId("play").addEventListener("click", () => {
    const playing = state.playing;
    stop();
    if (!playing) start({ playing: true });
  });
  if (times.length) byId("pace").add(new Option("true speed", TRUE_SPEED, true, true));
  byId("pace").addEventListener("change", () => {
    if (!state.playing) return;
    stop();
    start({ playing: true });
  });
  byId("frame").addEventListener("input", (event) => {
    stop();
    showFrame(Number(event.target.value));
  });
  byId("reset").addEventListener("click", () => {
    stop();
    leaveFrame();
    setWeights(new Float32Array(nWeights));
  });
  plane.addEventListener("click", (event) => {
    const position = planePositions();
    let [best, least] = [0, Infinity];
    for (let i = 0; i < nFrames; i++) {
      const [x, y] = position(coefficients(i), i);
      const distance = Math.hypot(x - event.offsetX, y - event.offsetY);
      if (distance < least) [best, least] = [i, distance];
    }
    stop();
    showFrame(best);
  });

  // ---- looking round --------------------------------------------------------

  function zoomBy(factor) {
    state.zoom = Math.min(20, Math.max(0.2, state.zoom * factor));
    redraw();
  }

  function frontView() {
    Object.assign(state, { turn: [1, 0, 0, 0, 1, 0, 0, 0, 1], zoom: 1 });
    redraw();
  }

  const fingers = new Map();
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  scene.addEventListener("pointerdown", (event) => {
    scene.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  scene.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return nameNearest(event.offsetX, event.offsetY);
    const before = fingers.size === 2 ? spread() : 0;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (fingers.size === 2) zoomBy(spread() / (before || 1));
    else turnBy(0.01 * (event.clientX - last.x), 0.01 * (event.clientY - last.y));
  });
  for (const end of ["pointerup", "pointercancel"])
    scene.addEventListener(end, (event) => fingers.delete(event.pointerId));
  scene.addEventListener("pointerleave", () => (byId("point").textContent = ""));
  scene.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(Math.exp(-0.0015 * event.deltaY));
  }, { passive: false });
  scene.addEventListener("keydown", (event) => {
    const actions = {
      ArrowLeft: () => turnBy(-0.1, 0), ArrowRight: () => turnBy(0.1, 0),
      ArrowUp: () => turnBy(0, -0.1), ArrowDown: () => turnBy(0, 0.1),
      "+": () => zoomBy(1.2), "=": () => zoomBy(1.2), "-": () => zoomBy(1 / 1.2), 0: frontView,
    };
    if (!(event.key in actions) || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    actions[event.key]();
  });
  byId("front").addEventListener("click", frontView);
  // The camera of a frame sees it from the front.
  byId("pose").addEventListener("change", (event) => event.target.checked && frontView());
  for (const id of ["ghost", "mirror", "over", "bars", "pose", "across", "upwards"])
    byId(id).addEventListener("change", redraw);

  function nameNearest(x, y) {
    let [best, least] = [-1, 10];
    for (let i = 0; latest && i < size; i += 3) {
      const distance = Math.hypot(latest[i] - x, latest[i + 1] - y);
      if (distance < least) [best, least] = [i / 3, distance];
    }
    byId("point").textContent = best < 0 ? "" : `point ${model.points[best]}`;
  }

  // ---- words ----------------------------------------------------------------

  byId("title").textContent =
    `3D shape model: ${nPoints} points, ${nWeights} basis shape${nWeights === 1 ? "" : "s"}`;
  byId("about").textContent = model.about;
  byId("count").textContent = model.count;
  byId("frames").hidden = !nFrames;
  byId("sides").hidden = !sides.length;
  byId("posed").hidden = !poses.length;
  for (const id of ["barred", "certainty"]) byId(id).hidden = !deviations.length;
  byId("frame").max = Math.max(nFrames - 1, 0);
  for (const [id, chosen] of [["across", nWeights > 1 ? 0 : -1], ["upwards", nWeights > 1 ? 1 : 0]]) {
    const names = [["order of rows", -1], ...model.components.map((name, k) => [name, k])];
    for (const [name, k] of names) byId(id).add(new Option(name, k, false, k === chosen));
  }
  model.categories.forEach((name, code) => {
    const item = document.createElement("li");
    const swatch = document.createElement("span");
    swatch.className = "swatch";
    swatch.style.background =
      model.categories.length <= N_COLOURS ? `var(--label-${code})` : labelColour(code);
    item.append(swatch, name);
    byId("legend").append(item);
  });

  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  new ResizeObserver(redraw).observe(scene);
  // For scripts that look at the page.
  window.viewer = {
    points: () => Array.from(shapeOf(state.weights)),
    projected: () => Array.from(project(shapeOf(state.weights))),
    bars: () => endsOfBars(shapeOf(state.weights)).flatMap((end) => Array.from(end)),
    state: () => ({ ...state, weights: Array.from(state.weights) }),
  };
  showButtons();
  turnBy(OPENED, 0);
  showWeights();
  if (deviations.length) showFrame(0);
})();
