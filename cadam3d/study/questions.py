"""Questions: what a rater decides about each pair of turntables, as in the study of the paper."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Question:
    """One question, which is always answered with the left or the right side."""

    name: str  # in files, such as texture_detail
    short: str  # the column of the paper's table, such as TD
    label: str  # the title in tables, such as Texture detail
    text: str  # the question on the page


# The names and their order come from the paper's table of the user study; the wording is ours, because the
# paper prints only the names.
QUESTIONS = (
    Question("text_alignment", "TA", "Text alignment", "Which object matches the description better?"),
    Question(
        "texture_detail", "TD", "Texture detail", "Which object has the finer and richer surface detail?"
    ),
    Question(
        "geometric_plausibility", "GP", "Geometric plausibility", "Which object has the more plausible shape?"
    ),
    Question(
        "cleanliness", "CL", "Cleanliness", "Which object is cleaner, with less noise and fewer stray specks?"
    ),
    Question("overall", "OP", "Overall preference", "Which object do you prefer overall?"),
)
QUESTION_NAMES = tuple(question.name for question in QUESTIONS)
