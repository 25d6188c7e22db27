"""Colours by role, for both themes; after Okabe and Ito, so that they differ for colour-blind readers too."""

from __future__ import annotations

LIGHT = {
    "paper": "#fbfaf7", "card": "#ffffff", "ink": "#1b2127", "muted": "#5a6570", "grid": "#e4e1da",
    "line": "#c9c5bb",
    "encoder": "#a9b1b9", "estimate": "#0067a5", "error": "#c44e00", "sigma": "#e69f00", "probe": "#00785a",
    "current": "#8f4d86", "excitation": "#0067a5", "load": "#6b7580",
    "unknown": "#8a929a", "locked": "#e69f00", "valid": "#009e73",
}
DARK = {
    "paper": "#11151a", "card": "#191f26", "ink": "#e8ebee", "muted": "#9aa6b2", "grid": "#262e37",
    "line": "#3a444f",
    "encoder": "#6f7b87", "estimate": "#5db9f0", "error": "#ff9457", "sigma": "#e69f00", "probe": "#35c79f",
    "current": "#d79bcf", "excitation": "#5db9f0", "load": "#8c98a4",
    "unknown": "#7d8893", "locked": "#e69f00", "valid": "#22b98b",
}


def css_variables(colours: dict[str, str]) -> str:
    """The palette as CSS custom properties."""
    return "".join(f"--{name}:{value};" for name, value in colours.items())
