"use strict";
// A small 3-D view: lines and a time line; drag turns it, the wheel comes nearer.
for (const box of document.querySelectorAll(".scene")) {
  const scene = JSON.parse(box.querySelector(".scene-data").textContent);
  const canvas = box.querySelector("canvas"), slider = box.querySelector("input");
  const told = box.querySelector("output"), pen = canvas.getContext("2d");
  let yaw = -0.6, pitch = 0.75, zoom = 1, pinch = 0;
  const low = scene.low, high = scene.high;
  const middle = low.map((v, i) => (v + high[i]) / 2);
  const size = Math.hypot(...low.map((v, i) => high[i] - v)) || 1;
  function flat(p) {
    const x = p[0] - middle[0], y = p[1] - middle[1], z = p[2] - middle[2];
    const c = Math.cos(yaw), s = Math.sin(yaw);
    const u = c * x - s * y, v = s * x + c * y;
    const k = zoom * Math.min(canvas.width, canvas.height * 1.15) / size;
    return [canvas.width / 2 + k * u,
      canvas.height / 2 - k * (Math.sin(pitch) * v + Math.cos(pitch) * z)];
  }
  function line(points, colour, width, alpha) {
    pen.beginPath();
    let begun = false;
    for (const p of points) {
      if (p[0] === null || p[1] === null || p[2] === null) { begun = false; continue; }
      const [a, b] = flat(p);
      if (begun) pen.lineTo(a, b); else pen.moveTo(a, b);
      begun = true;
    }
    pen.strokeStyle = colour; pen.lineWidth = width; pen.globalAlpha = alpha; pen.stroke();
    pen.globalAlpha = 1;
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, wide = canvas.clientWidth;
    if (!wide) return;
    canvas.width = wide * ratio; canvas.height = canvas.clientHeight * ratio;
    const look = getComputedStyle(document.documentElement);
    const colour = name => look.getPropertyValue("--" + name).trim();
    const [x0, y0, z0] = low, [x1, y1, z1] = high, floor = Math.max(z0, 0);
    const edge = z => [[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z], [x0, y0, z]];
    for (let x = Math.ceil(x0); x <= x1; x++) line([[x, y0, floor], [x, y1, floor]], colour("line"), ratio, 0.8);
    for (let y = Math.ceil(y0); y <= y1; y++) line([[x0, y, floor], [x1, y, floor]], colour("line"), ratio, 0.8);
    line(edge(floor), colour("dim"), ratio, 0.7); line(edge(z1), colour("dim"), ratio, 0.4);
    for (const p of edge(z1).slice(0, 4)) line([p, [p[0], p[1], floor]], colour("dim"), ratio, 0.3);
    for (const s of scene.solids) line(s.points, colour(s.colour), 1.3 * ratio, 0.85);
    const at = slider ? Number(slider.value) : Infinity;
    for (const path of scene.paths) {
      line(path.points, colour(path.colour), 2 * ratio, 0.45);
      let i = path.time.findIndex(t => t > at);
      if (i < 0) i = path.time.length;
      line(path.points.slice(0, i), colour(path.colour), 2.4 * ratio, 1);
      const p = path.points[Math.max(0, i - 1)];
      if (p && p[0] !== null) {
        const [a, b] = flat(p);
        pen.beginPath(); pen.arc(a, b, 5 * ratio, 0, 7); pen.fillStyle = colour(path.colour); pen.fill();
      }
    }
    pen.font = 12 * ratio + "px sans-serif";
    // Names of what happened at one place stand below each other, and inside of the picture.
    const taken = [];
    for (const m of scene.marks) {
      const [a, b] = flat(m.point), long = pen.measureText(m.text).width, high = 14 * ratio;
      const left = Math.max(0, Math.min(a + 6 * ratio, canvas.width - long - 4 * ratio));
      let base = b + (m.cross ? 14 : -4) * ratio;
      const hits = t => left < t[0] + t[2] && t[0] < left + long && Math.abs(base - t[1]) < high - 1;
      if (m.cross) { for (let t; (t = taken.find(hits));) base = t[1] + high; taken.push([left, base, long]); }
      pen.fillStyle = colour(m.colour); pen.fillText(m.text, left, base);
      if (m.cross) { pen.beginPath(); pen.arc(a, b, 4 * ratio, 0, 7); pen.fill(); }
    }
    if (told) told.textContent = at.toFixed(2) + " s";
  }
  const held = new Map();
  canvas.addEventListener("pointerdown", e => { held.set(e.pointerId, e); canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", e => {
    const before = held.get(e.pointerId);
    if (!before) return;
    held.set(e.pointerId, e);
    if (held.size === 2) {
      const [a, b] = [...held.values()], far = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (pinch) zoom = Math.min(20, Math.max(0.3, zoom * far / pinch));
      pinch = far;
    } else {
      yaw -= (e.clientX - before.clientX) * 0.008;
      pitch = Math.min(1.57, Math.max(0, pitch + (e.clientY - before.clientY) * 0.006));
    }
    draw();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, e => { held.delete(e.pointerId); pinch = 0; });
  canvas.addEventListener("wheel", e => {
    e.preventDefault(); zoom = Math.min(20, Math.max(0.3, zoom * Math.exp(-e.deltaY * 0.001))); draw();
  }, {passive: false});
  if (slider) slider.addEventListener("input", draw);
  window.addEventListener("resize", draw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  const around = box.closest("details");
  if (around) around.addEventListener("toggle", draw);
  draw();
}
