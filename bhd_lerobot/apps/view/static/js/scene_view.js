// The robot and what is around it in three dimensions. Drag turns the view, the wheel zooms, a double click resets it.

import { colour } from "./canvas.js";
import { make } from "./dom.js";
import { beams, reach } from "./scan_view.js";
import { frameAt } from "./store.js";
import { WALL } from "./top_view.js";

const START = { azimuth: -2.1, elevation: 0.65, zoom: 1 };
const eye = { ...START }; // kept from episode to episode, so that they can be compared
const stages = []; // one for each view on the page: a browser has few WebGL contexts
let library = null; // three.js, loaded when first needed

// Return something with an element and `show()`, which follows the time of the page; `place` tells views apart.
export function sceneView(together, place) {
  const stage = (stages[place] ??= open());
  stage.fill(together);
  return stage;
}

function open() {
  const canvas = make("canvas", { role: "img", "aria-label": "the robot and what is around it, in three dimensions" });
  const stage = { elements: [canvas], show: () => {}, fill: () => {} };
  const context = canvas.getContext("webgl2", { antialias: true });
  if (!context) {
    stage.elements = [make("div", { class: "problem" }, "This browser has no WebGL, which the view in three dimensions needs.")];
    return stage;
  }
  let together = null, drawn = null;
  const draw = () => {
    if (!drawn || !canvas.clientWidth) return;
    drawn(canvas);
    canvas.dataset.frame = frameAt(together[0][1]);
  };
  stage.show = draw;
  stage.fill = async (episodes) => {
    together = episodes;
    drawn = null;
    library ??= import("/static/vendor/three/three.module.min.js");
    const three = await library;
    if (together !== episodes) return; // another episode was chosen meanwhile
    stage.renderer ??= new three.WebGLRenderer({ canvas, context, antialias: true });
    stage.renderer.localClippingEnabled = true;
    drawn = built(three, stage.renderer, episodes);
    draw();
  };
  control(canvas);
  new ResizeObserver(draw).observe(canvas);
  return stage;
}

function control(canvas) {
  const redraw = () => stages.forEach((stage) => stage.show());
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (!canvas.hasPointerCapture(event.pointerId)) return;
    eye.azimuth -= event.movementX * 0.008;
    eye.elevation = Math.min(1.55, Math.max(0.03, eye.elevation + event.movementY * 0.008));
    redraw();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    eye.zoom = Math.min(8, Math.max(0.3, eye.zoom * Math.exp(-event.deltaY * 0.001)));
    redraw();
  }, { passive: false });
  canvas.addEventListener("dblclick", () => {
    Object.assign(eye, START);
    redraw();
  });
}

// Return what draws some episodes of one scene at the time of the page.
function built(three, renderer, together) {
  const scene = new three.Scene(), camera = new three.PerspectiveCamera(40, 1, 0.01, 200);
  camera.up.set(0, 0, 1);
  const sun = new three.DirectionalLight(0xffffff, 2.2);
  sun.position.set(-2, -3, 5);
  scene.add(new three.HemisphereLight(0xffffff, 0x9a9a9a, 1.9), sun);
  const first = together[0][1], arm = first.views.arm, arena = first.scene?.kind === "arena" ? first.scene : null;
  const { middle, size } = arena ? ofExtent(arena.extent) : arm ? { middle: [0.25, 0, 0.2], size: 0.95 } : ofWay(together);
  const updates = [floor(three, scene, arena, arm, middle, size)];
  if (arena) walls(three, scene, arena);
  together.forEach(([name, episode], number) => {
    if (episode.views.base) updates.push(base(three, scene, name, episode));
    if (episode.views.arm) updates.push(limbs(three, scene, name, episode, together.length === 1));
    if (episode.views.arm) updates.push(...objects(three, scene, episode, number));
  });
  return (canvas) => {
    for (const update of updates) update();
    renderer.setPixelRatio(window.devicePixelRatio || 1);
    renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
    renderer.setClearColor(colour("--raised"));
    camera.aspect = canvas.clientWidth / canvas.clientHeight;
    const distance = (1.5 * size) / eye.zoom / Math.min(1, camera.aspect);
    const flat = distance * Math.cos(eye.elevation);
    camera.position.set(
      middle[0] + flat * Math.cos(eye.azimuth), middle[1] + flat * Math.sin(eye.azimuth),
      middle[2] + distance * Math.sin(eye.elevation));
    camera.lookAt(...middle);
    camera.updateProjectionMatrix();
    renderer.render(scene, camera);
  };
}

const ofExtent = ([x0, x1, y0, y1]) => ({ middle: [(x0 + x1) / 2, (y0 + y1) / 2, 0], size: 0.85 * Math.hypot(x1 - x0, y1 - y0) });

function ofWay(together) {
  const box = [-0.5, 0.5, -0.5, 0.5];
  for (const [, { arrays, frames }] of together) {
    const { values } = arrays["view.base"];
    for (let i = 0; i < 3 * frames; i += 3) {
      if (!Number.isFinite(values[i] + values[i + 1])) continue;
      box[0] = Math.min(box[0], values[i]);
      box[1] = Math.max(box[1], values[i]);
      box[2] = Math.min(box[2], values[i + 1]);
      box[3] = Math.max(box[3], values[i + 1]);
    }
  }
  return ofExtent(box);
}

// A material whose colour is the theme's, also after the theme has changed.
function themed(three, updates, name, options = {}) {
  const material = new three.MeshLambertMaterial(options);
  updates.push(() => material.color.set(colour(name)));
  return material;
}

function floor(three, scene, arena, arm, [x, y], size) {
  const updates = [], each = arm ? 0.2 : 1; // [m] between the lines
  const [wide, long] = arena ? [arena.extent[1] - arena.extent[0], arena.extent[3] - arena.extent[2]] : [1.6 * size, 1.6 * size];
  const plane = new three.Mesh(new three.PlaneGeometry(wide, long), themed(three, updates, "--floor", { side: 2 }));
  plane.position.set(x, y, arm ? -0.002 : -0.004);
  scene.add(plane);
  const points = [];
  for (let at = Math.ceil((x - wide / 2) / each) * each; at <= x + wide / 2; at += each) points.push([at, y - long / 2, 0], [at, y + long / 2, 0]);
  for (let at = Math.ceil((y - long / 2) / each) * each; at <= y + long / 2; at += each) points.push([x - wide / 2, at, 0], [x + wide / 2, at, 0]);
  const lines = new three.LineSegments(
    new three.BufferGeometry().setFromPoints(points.map((p) => new three.Vector3(...p))), new three.LineBasicMaterial());
  updates.push(() => lines.material.color.set(colour("--line")));
  scene.add(lines);
  return () => updates.forEach((update) => update());
}

function walls(three, scene, arena) {
  const [x0, x1, y0, y1] = arena.extent;
  const plane = (x, y, distance) => new three.Plane(new three.Vector3(x, y, 0), distance + WALL + 1e-4);
  const material = new three.MeshLambertMaterial({
    color: colour("--wall"), side: 2, // what is built beyond the outer walls is cut off, and open there
    clippingPlanes: [plane(1, 0, -x0), plane(-1, 0, x1), plane(0, 1, -y0), plane(0, -1, y1)],
  });
  const low = Math.min(0.5, 0.12 * Math.max(x1 - x0, y1 - y0));
  for (const [kind, x, y, yaw, sizeX, sizeY, height = 0.5] of arena.shapes) {
    const tall = Math.min(height, low); // as high as they are, or what is behind them could not be seen
    const geometry = kind === "cylinder"
      ? new three.CylinderGeometry(sizeX, sizeX, tall, 32).rotateX(Math.PI / 2)
      : new three.BoxGeometry(2 * sizeX, 2 * sizeY, tall);
    const mesh = new three.Mesh(geometry, material);
    mesh.position.set(x, y, tall / 2);
    mesh.rotation.z = yaw;
    scene.add(mesh);
  }
  if (!arena.goal) return;
  const goal = new three.Mesh(new three.ConeGeometry(0.07, 0.25, 24).rotateX(-Math.PI / 2), new three.MeshLambertMaterial({ color: colour("--good") }));
  goal.position.set(arena.goal[0], arena.goal[1], 0.6);
  scene.add(goal);
}

function line(three, points, hue) {
  const geometry = new three.BufferGeometry().setFromPoints(points.map((p) => new three.Vector3(...p)));
  return new three.Line(geometry, new three.LineBasicMaterial({ color: hue }));
}

function base(three, scene, name, episode) {
  const { values } = episode.arrays["view.base"], { outline, height, radius } = episode.views.base;
  const robot = new three.Group(), hue = colour(`--${name}`), body = new three.MeshLambertMaterial({ color: hue });
  for (const [rear, front, half] of outline ?? [[-radius, radius, 0.7 * radius]]) {
    const hull = new three.Mesh(new three.BoxGeometry(front - rear, 2 * half, 0.7 * height), body);
    hull.position.set((front + rear) / 2, 0, 0.4 * height);
    robot.add(hull);
  }
  const nose = new three.Mesh(new three.ConeGeometry(0.3 * radius, 0.6 * radius, 20).rotateZ(-Math.PI / 2), new three.MeshLambertMaterial({ color: 0xf2b705 }));
  nose.position.set(0.75 * radius, 0, 0.8 * height); // where it is heading
  robot.add(nose);
  const way = [];
  for (let frame = 0; frame < episode.frames; frame += Math.ceil(episode.frames / 3000)) {
    const at = [values[3 * frame], values[3 * frame + 1], 0.005];
    if (at.every(Number.isFinite)) way.push(at);
  }
  const points = new three.BufferAttribute(new Float32Array(3 * (episode.views.scan?.beams ?? 0)), 3);
  const seen = new three.Points(new three.BufferGeometry().setAttribute("position", points), new three.PointsMaterial({ color: hue, size: 3, sizeAttenuation: false }));
  seen.frustumCulled = false; // its bounds would be those of the first frame
  scene.add(robot, line(three, way, hue), seen);
  return () => {
    const frame = frameAt(episode), [x, y, yaw] = values.subarray(3 * frame, 3 * frame + 3);
    robot.visible = [x, y, yaw].every(Number.isFinite);
    robot.position.set(x, y, 0);
    robot.rotation.z = yaw;
    if (!episode.views.scan || !robot.visible) return;
    const most = reach(episode) - 1e-3, ahead = episode.views.scan.x;
    const hits = beams(episode, frame).filter(([, distance]) => Number.isFinite(distance) && distance < most);
    const [left, front] = [x + ahead * Math.cos(yaw), y + ahead * Math.sin(yaw)];
    hits.forEach(([angle, distance], number) =>
      points.setXYZ(number, left + distance * Math.cos(yaw + angle), front + distance * Math.sin(yaw + angle), height));
    points.needsUpdate = true;
    seen.geometry.setDrawRange(0, hits.length);
  };
}

function limbs(three, scene, name, episode, isAlone) {
  const { values, width } = episode.arrays["view.capsules"], { radii, hand } = episode.views.arm;
  const ends = (frame, number) => {
    const from = frame * width + 6 * number;
    return [new three.Vector3(...values.subarray(from, from + 3)), new three.Vector3(...values.subarray(from + 3, from + 6))];
  };
  const updates = [], own = (number) => (isAlone ? (number >= hand ? "--hand" : "--limb-light") : `--${name}`);
  const upwards = new three.Vector3(0, 1, 0);
  const capsules = radii.map((radius, number) => {
    const [one, other] = ends(0, number), long = one.distanceTo(other);
    const slim = 0.72 * radius; // slimmer than in the collision checks, which are generous
    const mesh = new three.Mesh(new three.CapsuleGeometry(slim, long, 8, 20), themed(three, updates, own(number)));
    scene.add(mesh);
    return mesh;
  });
  const { values: tool } = episode.arrays["view.tool"], way = [];
  for (let frame = 0; frame < episode.frames; frame += Math.ceil(episode.frames / 3000)) way.push([...tool.subarray(3 * frame, 3 * frame + 3)]);
  scene.add(line(three, way.filter((point) => point.every(Number.isFinite)), colour(`--${name}`)));
  updates.push(() => capsules.forEach((mesh, number) => {
    const [one, other] = ends(frameAt(episode), number), along = other.clone().sub(one);
    mesh.visible = [...one, ...other].every(Number.isFinite);
    mesh.position.copy(one).add(other).multiplyScalar(0.5);
    if (along.lengthSq() > 1e-12) mesh.quaternion.setFromUnitVectors(upwards, along.normalize());
  }));
  return () => updates.forEach((update) => update());
}

function objects(three, scene, episode, number) {
  const moved = episode.arrays["view.objects"], target = episode.scene?.target_object;
  if (number > 0 && !moved) return [];
  const updates = (episode.scene?.objects ?? []).map((one, index) => {
    const geometry = one.kind === "box"
      ? new three.BoxGeometry(2 * one.size_x, 2 * one.size_y, one.height)
      : new three.CylinderGeometry(one.size_x, one.size_x, one.height, 32).rotateX(Math.PI / 2);
    const hue = new three.Color(...(episode.scene.colours[one.colour] ?? [0.5, 0.5, 0.5])).convertSRGBToLinear();
    const mesh = new three.Mesh(geometry, new three.MeshLambertMaterial({ color: hue }));
    const mark = new three.Mesh(new three.TorusGeometry(Math.hypot(one.size_x, one.size_y) + 0.02, 0.003, 8, 40), new three.MeshBasicMaterial());
    mark.visible = index === target; // which one is meant
    scene.add(mesh, mark);
    return () => {
      const from = frameAt(episode) * (moved?.width ?? 0) + 7 * index;
      const pose = moved ? moved.values.subarray(from, from + 7)
        : [one.x, one.y, one.height / 2, Math.cos(one.yaw / 2), 0, 0, Math.sin(one.yaw / 2)];
      mesh.visible = Number.isFinite(pose[0]);
      mark.visible = mesh.visible && index === target;
      mark.material.color.set(colour("--text"));
      mesh.position.set(pose[0], pose[1], pose[2]);
      mesh.quaternion.set(pose[4], pose[5], pose[6], pose[3]);
      mark.position.copy(mesh.position);
    };
  });
  if (episode.scene?.target_pose) {
    const [x, y, z, w, i, j, k] = episode.scene.target_pose, axes = new three.AxesHelper(0.08);
    axes.position.set(x, y, z);
    if (Number.isFinite(k)) axes.quaternion.set(i, j, k, w);
    scene.add(axes);
  }
  return updates;
}
