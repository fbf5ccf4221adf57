"use strict";
/* Rounds as the report carries them -> numbers to draw. How they are packed is told in replays.py. */

/** Yield the whole numbers of a packed round. */
function* wholeNumbers(base64) {
  let number = 0;
  let place = 1;
  for (const character of atob(base64)) {
    const byte = character.charCodeAt(0);
    number += (byte % 128) * place;
    if (byte >= 128) {
      place *= 128;
    } else {
      yield number % 2 ? -(number + 1) / 2 : number / 2;
      number = 0;
      place = 1;
    }
  }
}

/**
 * Return a round: discs [x, y, radius] and its moments, from the start to its end.
 *
 * A moment has pursuers and velocities [[x, y]], target [x, y], state 0 open, 1 closed or 2 complete, area (R_m), angles
 * (theta_c), and of each direction its owner, -1 for nobody, and reach, how far the target gets.
 */
function decodeRound(round, world, units) {
  const numbers = wholeNumbers(round.data);
  const next = () => numbers.next().value;
  const discs = Array.from({ length: world.discs }, () => [0, 0, 0].map(() => next() * units.position));
  const moments = Array.from({ length: round.moments }, () => ({ pursuers: [], velocities: [] }));
  const series = (unit, put) => {
    let value = 0;
    for (const moment of moments) {
      value += next();
      put(moment, value * unit);
    }
  };
  const body = (key, unit) => {
    series(unit, (moment, value) => moment[key].push([value]));
    series(unit, (moment, value) => moment[key].at(-1).push(value));
  };
  for (let i = 0; i <= world.pursuers; i += 1) body("pursuers", units.position);
  for (let i = 0; i < world.pursuers; i += 1) body("velocities", units.velocity);
  for (const moment of moments) {
    moment.target = moment.pursuers.pop();
    moment.state = next();
    moment.area = next() * units.area;
    moment.angles = Array.from({ length: world.entities }, () => next() * units.angle);
    moment.owner = [];
    for (let stretches = next(); stretches > 0; stretches -= 1) {
      const length = next();
      const owner = next() - 1;
      for (let k = 0; k < length; k += 1) moment.owner.push(owner);
    }
    let reach = 0;
    moment.reach = moment.owner.map((owner) => (owner < 0 ? Infinity : (reach += next()) * units.reach));
  }
  return { ...round, discs, moments };
}
