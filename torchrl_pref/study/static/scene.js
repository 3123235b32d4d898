// A scene, drawn on a canvas: shapes in the task's own unit, y up.

import { moments } from "./server.js";

/** The corners of what is seen of several scenes, to show them at one scale. */
export function corners(scenes) {
  const at = (name, place, choose) => choose(...scenes.map((scene) => scene[name][place]));
  return {
    low: [at("low", 0, Math.min), at("low", 1, Math.min)],
    high: [at("high", 0, Math.max), at("high", 1, Math.max)],
  };
}

/** Height over width of what is seen. */
export function aspect(box, equal) {
  return equal ? (box.high[1] - box.low[1]) / (box.high[0] - box.low[0]) : 0.75;
}

/** The frames of a scene, its images loaded; an animated image has several. */
export async function framesOf(scene) {
  const shapes = [...scene.still, ...scene.frames.flat()];
  const urls = new Set(shapes.filter((one) => one.kind === "picture").map((one) => one.url));
  const loaded = new Map();
  for (const url of urls) loaded.set(url, await moments(url));
  const withImage = (shape, moment) => {
    if (shape.kind !== "picture") return shape;
    const { images } = loaded.get(shape.url);
    return { ...shape, image: images[Math.min(moment, images.length - 1)] };
  };
  const still = scene.still.map((shape) => withImage(shape, 0));
  const only = scene.frames.length === 1 ? [...loaded.values()] : [];
  const count = Math.max(scene.frames.length, ...only.map((one) => one.images.length));
  const frames = Array.from({ length: count }, (_, moment) => [
    ...still,
    ...scene.frames[Math.min(moment, scene.frames.length - 1)].map((one) => withImage(one, moment)),
  ]);
  const pictures = [...loaded.values()];
  return {
    frames,
    whole: pictures.every((one) => one.whole),
    // Where there is nothing but images they decide the shape.
    aspects: shapes.every((one) => one.kind === "picture")
      ? pictures.map(({ images: [image] }) => image.height / image.width)
      : [],
  };
}

/** Draw a frame. */
export function draw(canvas, shapes, box) {
  const context = canvas.getContext("2d");
  const { width, height } = canvas;
  const across = width / (box.high[0] - box.low[0]);
  const up = height / (box.high[1] - box.low[1]);
  const view = {
    point: ([x, y]) => [(x - box.low[0]) * across, height - (y - box.low[1]) * up],
    across,
    up,
    // Lines and letters are in points of a small figure, and grow a little with it.
    pixel: devicePixelRatio * Math.min(1.6, Math.max(0.8, canvas.clientWidth / 240)),
    width,
    height,
  };
  context.clearRect(0, 0, width, height);
  for (const shape of shapes) DRAW[shape.kind](context, shape, view);
}

function path(context, points, view) {
  context.beginPath();
  points.forEach((point, number) => {
    const [x, y] = view.point(point);
    if (number === 0) context.moveTo(x, y);
    else context.lineTo(x, y);
  });
}

const DRAW = {
  line(context, shape, view) {
    path(context, shape.points, view);
    context.strokeStyle = shape.colour;
    context.lineWidth = shape.width * view.pixel;
    context.lineJoin = "round";
    context.setLineDash(shape.dashed ? [6 * view.pixel, 4 * view.pixel] : []);
    context.stroke();
  },
  patch(context, shape, view) {
    path(context, shape.points, view);
    context.fillStyle = shape.colour;
    context.fill();
  },
  disc(context, shape, view) {
    const [x, y] = view.point(shape.centre);
    context.beginPath();
    context.ellipse(x, y, shape.radius * view.across, shape.radius * view.up, 0, 0, 2 * Math.PI);
    context.fillStyle = shape.colour;
    context.fill();
  },
  label(context, shape, view) {
    context.fillStyle = shape.colour;
    context.font = `${11 * view.pixel}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(shape.text, ...view.point(shape.at));
  },
  picture(context, shape, view) {
    if (!shape.image) return;
    const { image } = shape;
    const scale = Math.min(view.width / image.width, view.height / image.height);
    const [width, height] = [image.width * scale, image.height * scale];
    context.drawImage(image, (view.width - width) / 2, (view.height - height) / 2, width, height);
  },
};
