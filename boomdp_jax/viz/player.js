/* Plays the film that the page holds as JSON: a canvas, a clock, and hands on both. */

"use strict";
(() => {
  const element = (id) => document.getElementById(id);
  const data = JSON.parse(element("data").textContent);
  const { bodies, times, poses, links, wheels, colours } = data;
  const report = document.documentElement.dataset;
  const canvas = element("view"), pen = canvas.getContext("2d");
  const last = times.length - 1, duration = times[last];
  const PLAY = "M3 1.5v13L14 8z", PAUSE = "M3 2h3.6v12H3zM9.4 2H13v12H9.4z";

  let time = 0, isPlaying = false, previous = null, isDirty = true, numDrawn = 0;
  let scale = 1, centre = [0, 0], isFitted = true, width = 1, height = 1;

  // --- Where things are -------------------------------------------------------------

  /* The last frame at or before a time. */
  function frameAt(time) {
    let low = 0, high = last;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= time) low = middle; else high = middle - 1;
    }
    return low;
  }

  /* Poses at a time, in a straight line from one frame to the next. */
  function posesAt(time) {
    const frame = frameAt(time), next = Math.min(frame + 1, last);
    const gap = times[next] - times[frame];
    const share = gap > 0 ? (time - times[frame]) / gap : 0;
    return bodies.map((_, body) => [0, 1, 2].map((axis) => {
      const place = 3 * body + axis;
      return (1 - share) * poses[frame][place] + share * poses[next][place];
    }));
  }

  function toWorld([x, y, theta], [px, py]) {
    const cos = Math.cos(theta), sin = Math.sin(theta);
    return [x + cos * px - sin * py, y + sin * px + cos * py];
  }

  function toScreen([x, y]) {
    return [width / 2 + scale * (x - centre[0]), height / 2 - scale * (y - centre[1])];
  }

  function fit() {
    const [low, high] = data.bounds;
    centre = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
    scale = Math.min(width / (high[0] - low[0]), height / (high[1] - low[1]));
    isFitted = isDirty = true;
  }

  /* Zoom so that the point under the pointer stays there. */
  function zoom(factor, x, y) {
    const limit = Math.hypot(...data.bounds[1].map((v, i) => v - data.bounds[0][i]));
    const wanted = Math.min(Math.max(scale * factor, 20 / limit), 1e5 / limit);
    const shift = 1 / scale - 1 / wanted;
    centre[0] += (x - width / 2) * shift;
    centre[1] -= (y - height / 2) * shift;
    scale = wanted;
    isFitted = false;
    isDirty = true;
  }

  // --- Drawing ----------------------------------------------------------------------

  function trace(points) {
    pen.beginPath();
    points.forEach((point, i) => pen[i ? "lineTo" : "moveTo"](...toScreen(point)));
  }

  function line(points, colour, thickness, opacity = 1) {
    trace(points);
    pen.strokeStyle = colour;
    pen.lineWidth = thickness;
    pen.globalAlpha = opacity;
    pen.stroke();
    pen.globalAlpha = 1;
  }

  function shape(points, colour) {
    trace(points);
    pen.closePath();
    pen.fillStyle = colour;
    pen.fill();
    pen.strokeStyle = colours.edge;
    pen.lineWidth = 1.3;
    pen.stroke();
  }

  function text(words, x, y, align = "center", baseline = "middle") {
    pen.textAlign = align;
    pen.textBaseline = baseline;
    pen.lineWidth = 3;
    pen.strokeStyle = "rgba(255, 255, 255, 0.85)";
    pen.strokeText(words, x, y);
    pen.fillStyle = colours.edge;
    pen.fillText(words, x, y);
  }

  /* Lines at round numbers of metres, some 90 pixels apart, with the numbers. */
  function drawGrid() {
    const rough = 90 / scale, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((multiple) => multiple * power >= rough);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    pen.font = "11px system-ui, sans-serif";
    const labels = [];
    for (const axis of [0, 1]) {
      const reach = [width, height][axis] / 2 / scale;
      let number = Math.ceil((centre[axis] - reach) / step);
      for (; number * step <= centre[axis] + reach; number += 1) {
        const value = number * step, point = [...centre];
        point[axis] = value;
        const place = toScreen(point)[axis];
        pen.beginPath();
        if (axis) { pen.moveTo(0, place); pen.lineTo(width, place); }
        else { pen.moveTo(place, 0); pen.lineTo(place, height); }
        pen.strokeStyle = colours.grid;
        pen.lineWidth = number ? 0.7 : 1.6;
        pen.stroke();
        const words = value.toFixed(digits).replace("-", "\u2212") + " m";
        if (axis ? place < height - 26 && place > 14 : place > 44) {
          labels.push(axis ? [words, 6, place - 3, "left", "bottom"]
            : [words, place + 4, height - 5, "left", "bottom"]);
        }
      }
    }
    return labels;
  }

  function drawBody(body, pose) {
    const colour = body.isStatic ? colours.static : colours.body;
    if (body.vertices.length) {
      shape(body.vertices.map((corner) => toWorld(pose, corner)), colour);
      return;
    }
    pen.beginPath();
    pen.arc(...toScreen(pose), scale * body.radius, 0, 2 * Math.PI);
    pen.fillStyle = colour;
    pen.fill();
    pen.strokeStyle = colours.edge;
    pen.lineWidth = 1.3;
    pen.stroke();
    line([pose, toWorld(pose, [body.radius, 0])], colours.edge, 1);
  }

  function drawLink(link, now) {
    const colour = colours[link.kind];
    const ends = [toWorld(now[link.a], link.anchorA),
      link.b < 0 ? link.anchorB : toWorld(now[link.b], link.anchorB)];
    if (["distance", "prismatic"].includes(link.kind)) line(ends, colour, 2.5);
    ends.forEach((end, i) => {
      const body = [link.a, link.b][i];
      if (link.kind === "revolute" && body >= 0) line([now[body], end], colour, 1, 0.6);
    });
    for (const end of ends) {
      pen.beginPath();
      pen.arc(...toScreen(end), 4.5, 0, 2 * Math.PI);
      pen.fillStyle = "#ffffff";
      pen.fill();
      pen.strokeStyle = colour;
      pen.lineWidth = 2;
      pen.stroke();
    }
  }

  /* On the body, or under one that is too small to be read on. */
  function drawName(body, pose) {
    const reach = Math.max(body.radius, ...body.vertices.map((v) => Math.hypot(...v)));
    const isRoomy = 2 * scale * reach > pen.measureText(body.name).width;
    const [x, y] = toScreen(pose);
    text(body.name, x, y + (isRoomy ? 0 : scale * reach + 10));
  }

  function drawTrail(body, now) {
    const path = [];
    for (let frame = 0; frame <= frameAt(time); frame += 1) {
      path.push(poses[frame].slice(3 * body, 3 * body + 2));
    }
    path.push(now[body]);
    line(path, colours.trail, 1.5, 0.6);
  }

  function draw() {
    const density = window.devicePixelRatio || 1;
    pen.setTransform(density, 0, 0, density, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineJoin = "round";
    const now = posesAt(time);
    const labels = drawGrid();
    bodies.forEach((body, i) => drawBody(body, now[i]));
    if (element("trail").checked) {
      bodies.forEach((body, i) => { if (!body.isStatic) drawTrail(i, now); });
    }
    for (const wheel of wheels) {
      const corners = wheel.corners.map((corner) => toWorld(now[wheel.body], corner));
      shape(corners, colours.wheel);
    }
    for (const link of links) drawLink(link, now);
    for (const label of labels) text(...label);
    pen.font = "12px system-ui, sans-serif";
    if (element("names").checked) bodies.forEach((body, i) => drawName(body, now[i]));
    numDrawn += 1;
    element("now").textContent = time.toFixed(2);
    element("scrub").value = frameAt(time + 1e-9);
    report.frames = times.length;
    report.drawn = numDrawn;
    report.time = time.toFixed(3);
  }

  // --- Time -------------------------------------------------------------------------

  function setPlaying(value) {
    isPlaying = value && duration > 0;
    previous = null;
    element("icon").setAttribute("d", isPlaying ? PAUSE : PLAY);
    element("play").setAttribute("aria-label", isPlaying ? "Pause" : "Play");
    report.state = isPlaying ? "playing" : time >= duration ? "ended" : "paused";
  }

  function goTo(frame) {
    time = times[Math.min(Math.max(frame, 0), last)];
    isDirty = true;
    setPlaying(false);
  }

  function toggle() {
    if (!isPlaying && time >= duration) time = 0;
    setPlaying(!isPlaying);
    isDirty = true;
  }

  function tick(now) {
    if (isPlaying) {
      // After a pause of the whole page (another tab) it goes on where it was.
      const passed = previous === null ? 0 : Math.min((now - previous) / 1000, 0.25);
      previous = now;
      time += passed * Number(element("speed").value);
      isDirty = true;
      if (time >= duration && element("loop").checked) {
        time %= duration;
      } else if (time >= duration) {
        time = duration;
        setPlaying(false);
      }
    }
    if (isDirty) {
      isDirty = false;
      draw();
    }
    requestAnimationFrame(tick);
  }

  // --- Hands ------------------------------------------------------------------------

  const pointers = new Map();

  function spread() {
    const [first, second] = [...pointers.values()];
    return second ? Math.hypot(first[0] - second[0], first[1] - second[1]) : 0;
  }

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    canvas.classList.add("is-dragged");
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const wide = spread(), share = 1 / pointers.size;
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    centre[0] -= share * (event.offsetX - before[0]) / scale;
    centre[1] += share * (event.offsetY - before[1]) / scale;
    if (wide > 0) zoom(spread() / wide, event.offsetX, event.offsetY);
    isFitted = false;
    isDirty = true;
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => {
      pointers.delete(event.pointerId);
      if (!pointers.size) canvas.classList.remove("is-dragged");
    });
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-0.0015 * event.deltaY), event.offsetX, event.offsetY);
  }, { passive: false });
  canvas.addEventListener("dblclick", fit);
  element("fit").addEventListener("click", fit);
  element("play").addEventListener("click", toggle);
  element("scrub").addEventListener("input", (event) => {
    goTo(Number(event.target.value));
  });
  for (const id of ["names", "trail"]) {
    element(id).addEventListener("change", () => { isDirty = true; });
  }
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.matches("button, select, input[type=checkbox]")) return;
    const actions = {
      " ": toggle,
      ArrowLeft: () => goTo(frameAt(time - 1e-9)),
      ArrowRight: () => goTo(frameAt(time + 1e-9) + 1),
      Home: () => goTo(0),
      End: () => goTo(last),
      f: fit,
      "+": () => zoom(1.25, width / 2, height / 2),
      "-": () => zoom(0.8, width / 2, height / 2),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
  });

  /* A canvas of a new size is empty, and drawn at once lest it flicker. */
  function resize() {
    const density = window.devicePixelRatio || 1;
    width = canvas.clientWidth;
    height = canvas.clientHeight;
    canvas.width = Math.round(width * density);
    canvas.height = Math.round(height * density);
    if (isFitted) fit();
    draw();
  }

  // --- Start ------------------------------------------------------------------------

  function addToLegend(colour, words) {
    const entry = document.createElement("span"), patch = document.createElement("i");
    patch.style.background = colour;
    entry.append(patch, words);
    element("legend").append(entry);
  }

  document.title = data.title;
  element("title").textContent = data.title;
  element("end").textContent = duration.toFixed(2);
  element("scrub").max = last;
  element("trail").checked = data.trail;
  for (const [kind, words] of [
    ["revolute", "pin"], ["distance", "rod"], ["prismatic", "slide"], ["weld", "weld"],
  ]) {
    if (links.some((link) => link.kind === kind)) addToLegend(colours[kind], words);
  }
  if (wheels.length) addToLegend(colours.wheel, "wheel");
  if (bodies.some((body) => body.isStatic)) addToLegend(colours.static, "static");
  // Who has asked for less motion starts it by hand.
  setPlaying(!window.matchMedia("(prefers-reduced-motion: reduce)").matches);
  resize();
  new ResizeObserver(resize).observe(canvas);
  requestAnimationFrame(tick);
})();
