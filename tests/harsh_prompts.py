"""Prompts that survive only if they are read and quoted as text."""

# What commas, quotes, brackets, references and other scripts would change if they were not quoted.
HARSH = [
    "a corgi, front view, with a hat",
    "a,b",
    "12",
    "null",
    "a=b ~c +d",
    "'quoted' and \"quoted\"",
    "it's",
    "back\\slash \\' \\\\",
    "ends in a backslash\\",
    "{a: [1, 2]}",
    "range(0,3)",
    "[a] #1 trophy",
    "${oc.env:HOME}",
    "\\${seed} ${seed",
    "ein Würfel, куб, 立方体, مكعب 🧊👩‍🚀",
    "a\tb",
    "long " * 1900,
]
