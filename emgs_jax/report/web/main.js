// The page: what is chosen, what is drawn when, and what clicks do.
"use strict";

const $ = (id) => document.getElementById(id);
const BACKGROUND = [0.086, 0.098, 0.118], LIGHT = [0.957, 0.965, 0.976];
const SLOW = 60; // ms; a drawing that takes longer is drawn coarsely while the view moves
const FEW = 20000; // Gaussians that are drawn coarsely
const FOCAL = 0.9; // heights of the window, unless a frame is chosen
const REST = 200; // ms without a move until it is drawn in full

async function start() {
  const sets = await readSets(), arrays = sets.gaussians;
  const first = Math.max(ABOUT.frames.status.findIndex((status) => !["lost", "apart"].includes(status)), 0);
  const state = { frame: first, view: null, pivot: ABOUT.pivot, size: ABOUT.size, focal: FOCAL, flies: false,
                  atFrame: false, image: null, ruler: [], measures: false, paths: {}, seesThrough: true };
  const report = { state, arrays, sets, shown: arrays, frameTime: 0 };
  window.report = report; // for the tests, and whoever is curious
  wireStrip(report);
  try {
    report.splats = new SplatRenderer($("map"), arrays, BACKGROUND);
  } catch (error) {
    $("message").textContent = `The map cannot be drawn: ${error.message}. Pictures and curves need no WebGL.`;
    report.draw = () => {};
    report.showFrame = (row) => showPictures(report, row);
    report.showFrame(first);
    document.body.dataset.ready = "without WebGL";
    return;
  }
  report.layers = new Layers(arrays);
  report.overlay = new Overlay($("lines"), arrays, state);
  wireDrawing(report);
  wireChoices(report);
  report.home();
  report.showFrame(first, false);
  report.draw(1);
  document.body.dataset.ready = "yes";
}

function wireDrawing(report) {
  const { state, splats, overlay, arrays } = report;
  const box = $("view");
  let timer = null, isAsked = false;

  // The image's own camera where a frame is chosen, else one without distortion of its axes.
  report.lens = (width, height) => {
    const { camera } = ABOUT;
    const focal = state.focal * height;
    if (!state.atFrame) return { focal: [focal, focal], center: [(width - 1) / 2, (height - 1) / 2] };
    const scale = Math.min(width / camera.width, height / camera.height);
    const shift = [(width - scale * camera.width) / 2, (height - scale * camera.height) / 2];
    return { focal: [scale * camera.fx, scale * camera.fy],
             center: [scale * (camera.cx + 0.5) + shift[0] - 0.5, scale * (camera.cy + 0.5) + shift[1] - 0.5] };
  };
  // From outside one sees through the backs of walls and ceilings.
  const facing = (row) => {
    const { mean, normal } = report.shown, p = state.view.position;
    let sum = 0;
    for (let k = 0; k < 3; k++) sum += normal[3 * row + k] * (mean[3 * row + k] - p[k]);
    return sum <= 0;
  };
  report.draw = (share) => {
    const [width, height] = [box.clientWidth, box.clientHeight].map((side) => Math.round(side * devicePixelRatio));
    const coarse = [Math.max(1, Math.round(share * width)), Math.max(1, Math.round(share * height))];
    const { canvas } = splats;
    if (canvas.width !== coarse[0] || canvas.height !== coarse[1]) [canvas.width, canvas.height] = coarse;
    if (overlay.canvas.width !== width || overlay.canvas.height !== height) {
      [overlay.canvas.width, overlay.canvas.height] = [width, height];
    }
    const begin = performance.now(), lens = report.lens(canvas.width, canvas.height);
    const step = share < 1 ? Math.ceil(splats.count / FEW) : 1;
    splats.draw(state.view, lens, state.seesThrough && !state.atFrame ? facing : null, step);
    if (share === 1) report.frameTime = performance.now() - begin;
    overlay.draw(state.view, lens, width / canvas.width);
  };
  report.moved = () => {
    clearTimeout(timer);
    const share = report.frameTime > SLOW ? Math.max(0.2, Math.sqrt(SLOW / report.frameTime)) : 1;
    if (share < 1) timer = setTimeout(() => report.draw(1), REST);
    if (isAsked) return;
    isAsked = true;
    requestAnimationFrame(() => {
      isAsked = false;
      report.draw(share);
    });
  };
  report.home = () => {
    state.atFrame = false;
    state.pivot = ABOUT.pivot;
    state.focal = FOCAL;
    // As far away as it takes until a ball round the map fits into the narrower side of the window.
    const half = Math.atan((0.5 * Math.min(1, box.clientWidth / box.clientHeight)) / FOCAL);
    const away = add(mul(ABOUT.up, 0.95), mul(ABOUT.front, -0.6));
    state.view = lookAt(add(state.pivot, mul(unit(away), (0.5 * state.size) / Math.sin(half))), state.pivot, ABOUT.up);
    report.moved();
  };
  report.showFrame = (row, goesThere = true) => {
    showPictures(report, row);
    if (goesThere && Number.isFinite(poseAt(arrays.poses, row).position[0])) {
      state.atFrame = true;
      state.view = poseAt(arrays.poses, row);
      state.pivot = add(state.view.position, mul(state.view.ahead, 0.25 * state.size));
    }
    report.moved();
  };
  const leaveFrame = () => {
    if (state.atFrame) { // the same picture as before, from a camera that may go on
      const scale = Math.min(box.clientWidth / ABOUT.camera.width, box.clientHeight / ABOUT.camera.height);
      state.focal = (scale * ABOUT.camera.fy) / box.clientHeight;
      state.atFrame = false;
    }
    report.moved();
  };
  report.controls = new Controls($("lines"), state, leaveFrame, (x, y) => clicked(report, x, y));
  new ResizeObserver(() => report.moved()).observe(box);
}

function wireChoices(report) {
  const { state, layers, splats } = report;
  const choose = () => {
    const name = $("layer").value, word = Number($("word").value), hasWord = name === "similarity" || name === "class";
    $("wordBox").hidden = !hasWord;
    $("thresholdBox").hidden = name !== "similarity";
    const chosen = name === "similarity" ? Math.max(word, 0) : word, kind = $("kind").value;
    if (report.shown !== report.sets[kind]) splats.load((report.shown = report.sets[kind]));
    const limits = [$("threshold"), $("existence")].map((slider) => Number(slider.value));
    splats.recolor(layers.paint(report.shown, name, chosen, ...limits));
    legend(layers, name, chosen);
    report.moved();
  };
  report.choose = choose;
  for (const id of ["kind", "layer", "word", "threshold", "existence"]) $(id).addEventListener("input", choose);
  for (const box of document.querySelectorAll("[data-path]")) {
    const show = () => {
      state.paths[box.dataset.path] = box.checked;
      report.moved();
    };
    box.addEventListener("input", show);
    show();
  }
  $("light").addEventListener("input", () => {
    splats.background = $("light").checked ? LIGHT : BACKGROUND;
    report.moved();
  });
  $("through").addEventListener("input", () => { state.seesThrough = $("through").checked; report.moved(); });
  $("home").addEventListener("click", report.home);
  $("fly").addEventListener("click", () => {
    state.flies = !state.flies;
    $("fly").setAttribute("aria-pressed", state.flies);
    $("lines").focus();
  });
  $("ruler").addEventListener("click", () => {
    state.measures = !state.measures;
    state.ruler = [];
    $("ruler").setAttribute("aria-pressed", state.measures);
    report.moved();
  });
  choose();
}

function legend(layers, name, word) {
  const range = layers.range(name, word), box = $("legend");
  box.replaceChildren();
  if (range) {
    const { text } = SCALES[ABOUT.layers[name].scale];
    const bar = document.createElement("span");
    bar.className = "bar";
    const stops = [0, 0.2, 0.4, 0.6, 0.8, 1].map((share) => `rgb(${turbo(share).map(Math.round)})`);
    bar.style.background = `linear-gradient(to right, ${stops})`;
    box.append(text(range[0]), bar, text(range[1]));
  }
  if (name === "class")
    for (const label of ABOUT.classesSeen) {
      const item = document.createElement("button"), patch = document.createElement("i");
      patch.style.background = `rgb(${ABOUT.classColors[label]})`;
      item.append(patch, ABOUT.classes[label]);
      item.addEventListener("click", () => {
        $("word").value = word === label ? -1 : label;
        $("word").dispatchEvent(new Event("input"));
      });
      box.append(item);
    }
}

window.addEventListener("DOMContentLoaded", () => start().catch((error) => {
  $("message").textContent = `This page needs a browser of 2023 or later: ${error.message}`;
  document.body.dataset.ready = "failed";
  throw error;
}));
