// Which colour means what, in light and in dark surroundings.

const RAMP = ["#3b4cc0", "#3fa0c8", "#5ec27a", "#f2c14e", "#d1402f"];
const RODS = ["#2f7fd6", "#e0653a", "#2a9d74", "#b45cc4", "#c9a227", "#5b6ee1", "#d64570", "#4aa3a2"];
const SPHERES = ["#f59e0b", "#10a37f", "#d64570", "#7c5cd6"];
const CYLINDERS = "#9aa3b0";

// Few rods get colours that are easy to tell apart, many a range of hues.
function rodColour(rod, rods) {
  if (rods <= RODS.length) return RODS[rod];
  const hue = 200 + (200 * rod) / (rods - 1);
  const channel = (shift) => {
    const value = 0.56 - 0.3 * Math.cos(((hue + shift) * Math.PI) / 180 + Math.PI);
    return Math.round(255 * clamp(value, 0, 1)).toString(16).padStart(2, "0");
  };
  return `#${channel(0)}${channel(-120)}${channel(120)}`;
}

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => linearColour(style.getPropertyValue(`--${name}`).trim());
  const number = (name) => parseFloat(style.getPropertyValue(`--${name}`));
  return {
    grid: colour("grid"), shadow: colour("shadow"),
    x: colour("x"), y: colour("y"), z: colour("z"),
    shadowStrength: number("shadow-strength"), trail: number("trail"), rings: 0.3,
    ramp: RAMP.map(linearColour),
  };
}
