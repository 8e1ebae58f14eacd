"""Page: one HTML file that shows a study to raters, without a library and without a request to the network.

The page contains descriptions, clips and questions. It contains no names of arms or files and no numbers of
Gaussians. Each clip has a random number, and only the key of the study says what it shows.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path

from cadam3d.io.html import content_hash, encoded, fill, source
from cadam3d.study.questions import QUESTIONS
from cadam3d.study.trials import Trial

SOURCES = Path(__file__).parent
ID_LENGTH = 16  # characters
SECONDS_PER_ANSWER = 5  # for the estimate on the first screen


def study_id(trials: Sequence[Trial], clips: Sequence[Sequence[bytes]]) -> str:
    """Return the name of a study, which depends on everything that its raters see."""
    hashes = [[hashlib.sha256(frame).hexdigest() for frame in clip] for clip in clips]
    content = _trials_json(trials) + json.dumps(hashes)
    return hashlib.sha256(content.encode()).hexdigest()[:ID_LENGTH]


def study_page(
    study: str, trials: Sequence[Trial], clips: Sequence[Sequence[bytes]], *, seconds: float, consent: str
) -> str:
    """Return the whole page: ``trials`` about ``clips``, each of which is a list of WebP pictures.

    ``seconds`` is the time of one turn. ``consent`` is text that is shown before the start; an empty line
    begins a paragraph. A policy in the page forbids every request and every other script.
    """
    code, look = source(SOURCES / "rater_page.js"), source(SOURCES / "rater_page.css")
    data = {
        "study": study,
        "seconds": seconds,
        "questions": [{"name": question.name, "text": question.text} for question in QUESTIONS],
        "trials": json.loads(_trials_json(trials)),
    }
    return fill(
        SOURCES / "rater_page.html.jinja",
        style=look,
        style_hash=content_hash(look),
        script=code,
        script_hash=content_hash(code),
        # Inside a script, a browser reads everything up to the next "</script" as it is.
        data=json.dumps(data, ensure_ascii=False).replace("<", "\\u003c"),
        clips=["\n".join(encoded(frame) for frame in clip) for clip in clips],
        consent=[text.strip() for text in consent.split("\n\n") if text.strip()],
        pairs=len(trials),
        questions=len(QUESTIONS),
        minutes=max(1, math.ceil(len(trials) * len(QUESTIONS) * SECONDS_PER_ANSWER / 60)),
    )


def _trials_json(trials: Sequence[Trial]) -> str:
    """Return the trials as the page has them, which does not include which of them are catch trials."""
    return json.dumps([{"prompt": trial.prompt, "clips": trial.clips} for trial in trials])
