// Colours of the surroundings, light and dark; those of what is shown come with it.

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => linearColour(style.getPropertyValue(`--${name}`).trim());
  const number = (name) => parseFloat(style.getPropertyValue(`--${name}`));
  return {
    grid: colour("grid"), shadow: colour("shadow"),
    x: colour("x"), y: colour("y"), z: colour("z"),
    shadowStrength: number("shadow-strength"), trail: number("trail"), rings: 0.3,
  };
}
