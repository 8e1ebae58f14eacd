"""Run folder: the names of the files that a run leaves, and of those that a sweep adds."""

# Written by training.
ASSET = "asset.ply"
CHARTS = "charts.json"  # the charts that the densifier and the objective declare
CHECKPOINTS = "checkpoints"  # a folder
CONFIG = "config.yaml"  # every setting, resolved
METRICS = "metrics.jsonl"
OVERRIDES = ".hydra/overrides.yaml"  # what was typed
SUMMARY = "summary.json"

# Written by exporters and callbacks.
CANDIDATES = "candidates"  # a folder
HISTOGRAMS = "candidates/histograms.jsonl"
IMAGES = "images"  # a folder
PREVIEW = "preview.png"
PREVIEWS = "previews"  # a folder
TURNTABLE = "turntable.mp4"

# Written after training, for a run or for a sweep.
EVALUATION = "eval.json"
REPORT = "report.html"

# Written by a sweep, into its own folder.
FIGURES = "figures"  # a folder
JOBS = "jobs.json"
TABLE = "sweep.csv"

# Written by a sweep, into the folder of each job.
CONSOLE = "console.txt"
ENDED = "job.json"
