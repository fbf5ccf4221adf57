/* One moment of a round on a canvas, in the order and the look of the package's own drawings. */

/** Half the side of the close-up [scene units]. */
const CLOSE_UP = 0.42;

/** Return the drawing's colours, those of the page's present theme. */
function readColours() {
  const style = getComputedStyle(document.documentElement);
  return (name) => style.getPropertyValue(`--${name}`).trim();
}

/**
 * Draw a moment.
 *
 * @param canvas as large as it is laid out
 * @param world what all rounds of the policy have in common
 * @param round a decoded round
 * @param step the moment's number
 * @param show what to lay over: circles, ring, area, trails, closeUp
 * @param colour see readColours
 */
function drawMoment(canvas, world, round, step, show, colour) {
  const side = canvas.clientWidth;
  const density = window.devicePixelRatio || 1;
  canvas.width = canvas.height = Math.round(side * density);
  const context = canvas.getContext("2d");
  context.setTransform(canvas.width / side, 0, 0, canvas.height / side, 0, 0);
  const moment = round.moments[step];
  const edge = Math.max(world.pursuerRadius, world.targetRadius, 0.04 * world.halfWidth);
  const half = show.closeUp ? CLOSE_UP * world.halfWidth : world.halfWidth + edge;
  const centre = show.closeUp ? moment.target : [0, 0];
  const scale = side / (2 * half);
  const place = ([x, y]) => [side / 2 + (x - centre[0]) * scale, side / 2 - (y - centre[1]) * scale];
  const sheet = { context, side, scale, place, colour, unit: Math.max(side / 560, 0.6) };

  drawGround(sheet, world);
  context.save();
  clipToScene(sheet, world);
  if (show.area) drawReach(sheet, world, moment);
  if (show.trails) drawTrails(sheet, world, round, step);
  if (show.circles) drawCircles(sheet, world, moment);
  context.restore();
  drawObstacles(sheet, round.discs);
  if (show.ring) drawRing(sheet, world, moment);
  moment.pursuers.forEach((_, i) => drawPursuer(sheet, world, moment, i));
  drawTarget(sheet, world, moment.target);
}

/** Name the colour of a pursuer or obstacle. */
function entityColour(entity, world) {
  return entity < world.pursuers ? `pursuer-${entity % world.colours}` : "obstacle";
}

function trace({ context, place }, points) {
  context.beginPath();
  points.forEach((point, i) => (i ? context.lineTo(...place(point)) : context.moveTo(...place(point))));
}

function disc({ context, scale, place }, centre, radius) {
  context.beginPath();
  context.arc(...place(centre), radius * scale, 0, 2 * Math.PI);
}

function polar(centre, angle, distance) {
  return [centre[0] + distance * Math.cos(angle), centre[1] + distance * Math.sin(angle)];
}

function clipToScene(sheet, world) {
  const h = world.halfWidth;
  trace(sheet, [[-h, -h], [h, -h], [h, h], [-h, h]]);
  sheet.context.closePath();
  sheet.context.clip();
}

function drawGround(sheet, world) {
  const { context, side, colour, unit } = sheet;
  const h = world.halfWidth;
  context.fillStyle = colour("background");
  context.fillRect(0, 0, side, side);
  trace(sheet, [[-h, -h], [h, -h], [h, h], [-h, h]]);
  context.closePath();
  context.fillStyle = colour("paper");
  context.fill();
  context.lineWidth = unit;
  context.strokeStyle = colour("groove");
  for (let i = 1; i < 8; i += 1) {
    const at = h * (i / 4 - 1);
    trace(sheet, [[at, -h], [at, h]]);
    context.stroke();
    trace(sheet, [[-h, at], [h, at]]);
    context.stroke();
  }
  trace(sheet, [[-h, -h], [h, -h], [h, h], [-h, h]]);
  context.closePath();
  context.lineWidth = 1.5 * unit;
  context.strokeStyle = colour("line");
  context.stroke();
}

/** Yield [owner, first, last] of each stretch of neighbouring directions with one owner; last may pass the full circle. */
function* stretches(owner) {
  const count = owner.length;
  const starts = owner.map((_, k) => k).filter((k) => owner[k] !== owner[(k + count - 1) % count]);
  if (!starts.length) {
    yield [owner[0], 0, count - 1];
    return;
  }
  for (let i = 0; i < starts.length; i += 1) {
    const end = i + 1 < starts.length ? starts[i + 1] : starts[0] + count;
    yield [owner[starts[i]], starts[i], end - 1];
  }
}

/** Tint what the target can reach before it is met in the colour of who meets it there; outline it once it is closed. */
function drawReach(sheet, world, moment) {
  const { context, colour, unit } = sheet;
  const count = moment.owner.length;
  const turn = (2 * Math.PI) / count;
  const closed = moment.state > 0;
  const reach = (k) => moment.reach[(k + count) % count];
  for (const [owner, first, last] of stretches(moment.owner)) {
    if (owner < 0) continue;
    const low = closed ? (reach(first) + reach(first - 1)) / 2 : reach(first);
    const high = closed ? (reach(last) + reach(last + 1)) / 2 : reach(last);
    const outline = [moment.target, polar(moment.target, (first - 0.5) * turn, low)];
    for (let k = first; k <= last; k += 1) outline.push(polar(moment.target, k * turn, reach(k)));
    outline.push(polar(moment.target, (last + 0.5) * turn, high));
    trace(sheet, outline);
    context.globalAlpha = closed ? 0.43 : 0.17;
    context.fillStyle = colour(entityColour(owner, world));
    context.fill();
  }
  context.globalAlpha = 1;
  if (closed) {
    trace(sheet, moment.reach.map((distance, k) => polar(moment.target, k * turn, distance)));
    context.closePath();
    context.lineWidth = 1.6 * unit;
    context.lineJoin = "round";
    context.strokeStyle = colour("ink");
    context.stroke();
  }
}

function drawTrails(sheet, world, round, step) {
  const { context, colour, unit } = sheet;
  context.lineWidth = 1.8 * unit;
  context.lineCap = "round";
  for (let body = 0; body <= world.pursuers; body += 1) {
    const at = (t) => (body < world.pursuers ? round.moments[t].pursuers[body] : round.moments[t].target);
    context.strokeStyle = colour(body < world.pursuers ? entityColour(body, world) : "ink");
    for (let t = 1; t <= step; t += 1) {
      context.globalAlpha = Math.max(0.2, 0.85 - 0.03 * (step - t));
      trace(sheet, [at(t - 1), at(t)]);
      context.stroke();
    }
  }
  context.globalAlpha = 1;
}

/** Draw the part of each Apollonius circle that faces the target: the setting's arc, turned and scaled. */
function drawCircles(sheet, world, moment) {
  const { context, colour, unit } = sheet;
  const [x, y] = moment.target;
  context.lineWidth = 1.2 * unit;
  moment.pursuers.forEach((pursuer, i) => {
    const [dx, dy] = [pursuer[0] - x, pursuer[1] - y];
    trace(sheet, world.arc.map(([u, v]) => [x + u * dx - v * dy, y + u * dy + v * dx]));
    context.strokeStyle = colour(entityColour(i, world));
    context.stroke();
  });
}

function drawObstacles(sheet, discs) {
  const { context, colour, unit } = sheet;
  // All edges first: discs of one obstacle that overlap get one outline.
  for (const [name, inset] of [["obstacle-edge", 0], ["obstacle", (1.6 * unit) / sheet.scale]]) {
    context.fillStyle = colour(name);
    for (const [x, y, radius] of discs) {
      disc(sheet, [x, y], radius - inset);
      context.fill();
    }
  }
}

/** Draw a ring around the target whose segments, the contributing angles, have their owners' colours; thin for nobody. */
function drawRing(sheet, world, moment) {
  const { context, scale, place, colour } = sheet;
  const unit = Math.max(world.targetRadius, 0.02 * world.halfWidth) * scale;
  const turn = (2 * Math.PI) / moment.owner.length;
  const [x, y] = place(moment.target);
  for (const [owner, first, last] of stretches(moment.owner)) {
    context.beginPath();
    context.arc(x, y, 1.52 * unit, -(first - 0.5) * turn, -(last + 0.5) * turn, true);
    context.lineWidth = (owner < 0 ? 0.08 : 0.46) * unit;
    context.lineCap = "butt";
    context.strokeStyle = colour(owner < 0 ? "faint" : entityColour(owner, world));
    context.stroke();
  }
}

function drawPursuer(sheet, world, moment, i) {
  const { context, scale, place, colour, unit } = sheet;
  const [x, y] = place(moment.pursuers[i]);
  const [vx, vy] = moment.velocities[i];
  const radius = Math.max(world.pursuerRadius * scale, 4);
  const speed = Math.hypot(vx, vy) / world.maxSpeed;
  context.fillStyle = colour("ink");
  if (speed > 0.02) {
    const heading = Math.atan2(-vy, vx);
    context.beginPath();
    for (const [r, turn] of [[radius * (1.25 + 0.75 * speed), 0], [1.02 * radius, 0.5], [1.02 * radius, -0.5]]) {
      context.lineTo(...polar([x, y], heading + turn, r));
    }
    context.fill();
  }
  for (const [name, r] of [["ink", radius], [entityColour(i, world), radius - 1.4 * unit]]) {
    context.beginPath();
    context.arc(x, y, r, 0, 2 * Math.PI);
    context.fillStyle = colour(name);
    context.fill();
  }
  if (radius >= 6) {
    context.fillStyle = colour(`on-${entityColour(i, world)}`);
    context.font = `600 ${(1.15 * radius).toFixed(1)}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(String(i), x, y + 0.06 * radius);
  }
}

function drawTarget({ context, scale, place, colour }, world, target) {
  const [x, y] = place(target);
  const radius = Math.max(world.targetRadius * scale, 4);
  for (const [name, share] of [["ink", 1], ["paper", 0.55], ["ink", 0.27]]) {
    context.beginPath();
    context.arc(x, y, share * radius, 0, 2 * Math.PI);
    context.fillStyle = colour(name);
    context.fill();
  }
}
