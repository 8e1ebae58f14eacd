"""The colours of all charts and figures, each with its counterpart for dark pages.

Matplotlib draws with the light colours. On a page they become CSS variables, so that the page follows the
light or dark setting of the browser.
"""

PAPER, INK, SOFT, LINE = "#ffffff", "#1b1c1e", "#5d6167", "#e2e2de"
PAGE = {  # colour -> name of the variable, colour on dark pages
    PAPER: ("card", "#1c1e22"),
    INK: ("ink", "#ebebe8"),
    SOFT: ("soft", "#a0a5ad"),
    LINE: ("line", "#33363c"),
}
SERIES = {  # the curves of a chart, in order
    "#2a6fdb": ("series-1", "#6ea8ff"),
    "#d9731a": ("series-2", "#f0a04b"),
    "#168a6b": ("series-3", "#4cc4a0"),
    "#c2395b": ("series-4", "#f07a97"),
}
SERIES_COLORS = tuple(SERIES)
# The arms of a sweep, in order. The first ones are Okabe and Ito's or close to them, which people with
# any kind of colour vision can tell apart; markers differ too, for print in grey.
ARMS = {
    **{"#d55e00": "#ff9150", "#0072b2": "#62b3f0", "#009e73": "#3fcfa4", "#cc79a7": "#e5a0c8"},
    **{"#767676": "#a3a7ad", "#8c1c46": "#e2607f", "#8a5a44": "#c99a84", "#56b4e9": "#8fd0f7"},
    **{"#b07d00": "#e3b04b", "#6a5acd": "#a99ff0", "#5c7a00": "#a9c94f", "#00838f": "#4fc3cd"},
    **{"#1f2d6b": "#8ea0e8", "#b5179e": "#ee6fd8", "#5b2c6f": "#c9a0dc"},
}
VARIABLES = {  # colour -> name of its CSS variable
    **{color: name for color, (name, _) in {**PAGE, **SERIES}.items()},
    **{color: f"arm-{color[1:]}" for color in ARMS},
}
DARK = {**{color: dark for color, (_, dark) in {**PAGE, **SERIES}.items()}, **ARMS}


def css() -> str:
    """Return the definitions of all colour variables, for light and for dark pages."""
    light = "".join(f"--{name}: {color}; " for color, name in VARIABLES.items())
    dark = "".join(f"--{name}: {DARK[color]}; " for color, name in VARIABLES.items())
    return f":root {{ {light}}}\n@media (prefers-color-scheme: dark) {{ :root {{ {dark}}} }}\n"
