// The strip of frames, the pictures of the chosen one, and what a click into the map finds.
"use strict";

const numFrames = () => ABOUT.frames.status.length;

function wireStrip(report) {
  const strip = $("strip");
  const choose = (event) => {
    const box = $("cursor").parentElement.getBoundingClientRect();
    const share = (event.clientX - box.left) / box.width;
    if (share < 0 || share > 1) return;
    report.showFrame(Math.min(Math.floor(share * numFrames()), numFrames() - 1));
  };
  strip.addEventListener("click", choose);
  strip.addEventListener("pointermove", (event) => { if (event.buttons === 1) choose(event); });
  window.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step || ["SELECT", "INPUT"].includes(event.target.tagName)) return;
    event.preventDefault();
    report.showFrame(Math.min(Math.max(report.state.frame + step, 0), numFrames() - 1));
  });
  let playing = null;
  $("play").addEventListener("click", () => {
    clearInterval(playing);
    playing = playing ? null : setInterval(() => report.showFrame((report.state.frame + 1) % numFrames()), 150);
    $("play").textContent = playing ? "❚❚" : "▶";
  });
}

function showPictures(report, row) {
  report.state.frame = row;
  $("cursor").style.left = `${(100 * (row + 0.5)) / numFrames()}%`;
  const { frames, pictures } = ABOUT;
  const away = (picture) => Math.abs(picture[0] - row);
  const nearest = pictures.reduce((best, one) => (away(one) < away(best) ? one : best), pictures[0]);
  const title = document.createElement("b"), status = document.createElement("span");
  title.textContent = frames.title[row];
  status.textContent = frames.status[row];
  status.className = `status ${frames.status[row]}`;
  const facts = [frames.reason[row], frames.facts[row]];
  if (nearest && away(nearest)) facts.push(`pictures of ${frames.title[nearest[0]]}, the nearest that has some`);
  $("facts").replaceChildren(title, " ", status, " ", facts.filter(Boolean).join(" · "));
  ["seen", "rendered", "depth"].forEach((id, k) => {
    const content = nearest && nearest[k + 1];
    if (content) $(id).src = `data:image/jpeg;base64,${content}`;
    $(id).hidden = !content;
  });
  report.state.image = nearest && !away(nearest) && nearest[1] ? $("seen") : null;
  $("seen").onload = () => report.moved(); // it is in the frame's pyramid, too
}

// A click: the Gaussian in front there; its numbers, or an end of the ruler.
function clicked(report, x, y) {
  const found = pick(report, x, y), { state } = report;
  if (!found) return;
  if (state.measures) {
    state.ruler = state.ruler.length === 1 ? [state.ruler[0], found.point] : [found.point];
    report.moved();
    return;
  }
  state.pivot = found.point;
  const { arrays } = report, isSplat = report.shown === report.sets.splats;
  const row = isSplat ? report.shown.owner[found.row] : found.row;
  const place = found.point.map((value) => value.toFixed(3)).join(", ");
  const label = arrays.label && arrays.label[row] >= 0 ? ABOUT.classes[arrays.label[row]] + " · " : "";
  const numbers = `certain by ${(arrays.existence[row] / 255).toFixed(2)} · ${arrays.updates[row]} updates`;
  const what = `${isSplat ? `splat ${found.row} of ` : ""}Gaussian ${row}`;
  $("picked").textContent = `${what}: ${label}at ${place} · ${numbers} · born at step ${arrays.birth[row]}`;
}

// The nearest Gaussian whose ellipse holds the ray and whose plane it meets; x and y from the corner of the view.
function pick(report, x, y) {
  const { state, splats } = report, { mean: means, normal: normals, cov } = report.shown;
  const box = $("view"), { view } = state;
  const lens = report.lens(box.clientWidth, box.clientHeight);
  const ray = [(x - 0.5 - lens.center[0]) / lens.focal[0], (y - 0.5 - lens.center[1]) / lens.focal[1], 1];
  const way = sub(toWorld(view, ray), view.position);
  let best = null;
  for (let row = 0; row < splats.count; row++) {
    if (splats.depths[row] <= 0 || (best && splats.depths[row] > 1.5 * best.depth)) continue;
    const mean = means.subarray(3 * row, 3 * row + 3), normal = normals.subarray(3 * row, 3 * row + 3);
    const facing = dot(normal, way);
    if (Math.abs(facing) < 1) continue; // seen from the side; normals are of length 127
    const depth = dot(normal, sub(mean, view.position)) / facing;
    const point = add(view.position, mul(way, depth));
    const size = (cov[6 * row] + cov[6 * row + 3] + cov[6 * row + 5]) * ABOUT.covUnit; // its squared radius, at most
    const isHit = depth > 0 && norm(sub(point, mean)) ** 2 < 1.5 * size;
    if (isHit && (!best || depth < best.depth)) best = { row, point, depth };
  }
  return best;
}
