// Colours of the surroundings, light and dark; those of what is shown come with it.

const DARK = window.matchMedia("(prefers-color-scheme: dark)");

// A page around this one may ask for a theme at the end of the address.
function chooseTheme() {
  const asked = location.hash.slice(1);
  const preferred = DARK.matches ? "dark" : "light";
  document.documentElement.dataset.theme = ["dark", "light"].includes(asked) ? asked : preferred;
}
chooseTheme(); // before the recording is unpacked

function readTheme() {
  chooseTheme();
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => linearColour(style.getPropertyValue(`--${name}`).trim());
  const number = (name) => parseFloat(style.getPropertyValue(`--${name}`));
  return {
    grid: colour("grid"), shadow: colour("shadow"),
    x: colour("x"), y: colour("y"), z: colour("z"),
    shadowStrength: number("shadow-strength"), trail: number("trail"), rings: 0.3,
  };
}
