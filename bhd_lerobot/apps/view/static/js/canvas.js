// Drawing: sharp canvases, the theme's colours, and metres to pixels.

export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

// Return the context of a canvas whose unit is the CSS pixel, cleared, with its size.
export function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.lineJoin = context.lineCap = "round";
  return { context, width, height };
}

// Return what turns metres into pixels so that a range fits a box, to scale, y upwards.
export function fit([xMin, xMax, yMin, yMax], [left, top, width, height], margin = 8) {
  const scale = Math.max(1e-6, Math.min((width - 2 * margin) / (xMax - xMin), (height - 2 * margin) / (yMax - yMin)));
  const midX = (xMin + xMax) / 2, midY = (yMin + yMax) / 2;
  return {
    scale,
    point: (x, y) => [left + width / 2 + (x - midX) * scale, top + height / 2 - (y - midY) * scale],
  };
}

// Draw a line through points; one that is not finite breaks it.
export function polyline(context, points) {
  let isDown = false;
  context.beginPath();
  for (const [x, y] of points) {
    if (!Number.isFinite(x) || !Number.isFinite(y)) isDown = false;
    else if (isDown) context.lineTo(x, y);
    else {
      context.moveTo(x, y);
      isDown = true;
    }
  }
  context.stroke();
}

export function disc(context, [x, y], radius) {
  if (!Number.isFinite(x) || !Number.isFinite(y)) return;
  context.beginPath();
  context.arc(x, y, Math.max(0, radius), 0, 2 * Math.PI);
}

// Return the convex hull of points in the plane (Andrew's monotone chain).
export function hull(points) {
  const sorted = [...points].sort((p, q) => p[0] - q[0] || p[1] - q[1]);
  const half = (list) => {
    const chain = [];
    for (const p of list) {
      while (chain.length > 1 && cross(chain.at(-2), chain.at(-1), p) <= 0) chain.pop();
      chain.push(p);
    }
    return chain.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

const cross = (o, p, q) => (p[0] - o[0]) * (q[1] - o[1]) - (p[1] - o[1]) * (q[0] - o[0]);
