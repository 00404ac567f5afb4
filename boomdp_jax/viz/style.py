"""Colours that a colour-blind reader tells apart, one for each idea."""

PIN = "#D55E00"
"""Vermilion."""
WHEEL = "#0072B2"
"""Blue."""
ROD = "#CC79A7"
"""Purple."""
SLIDE = "#56B4E9"
"""Sky blue."""
WELD = "#000000"
"""Black."""
FLOOR = "#009E73"
"""Green."""
BODY = "#E8E4DA"
"""Fill of an outline."""
STATIC = "#9A9A9A"
"""Fill of what never moves."""
EDGE = "#333333"
"""Outlines and text."""
GRID = "#DDDDDD"
"""Lines of a ruled background."""
READING = "#000000"
PREDICTION = "#0072B2"
BASELINE = "#E69F00"
"""Orange."""

BY_KIND = {
    "revolute": PIN,
    "distance": ROD,
    "wheel": WHEEL,
    "ground": FLOOR,
    "prismatic": SLIDE,
    "weld": WELD,
}

OUTLINE_STYLE = {"facecolor": BODY, "edgecolor": EDGE, "linewidth": 1.2, "zorder": 1}
