"""`python -m planners ensemble models=[a,b,...] benchmark=...`: several GTRS-Dense models as one.

    python -m planners ensemble models=[runs/recovery,runs/pdm_closed,runs/rewards_only] benchmark=runs/hard out=eval

Their sub-scores are averaged, then weighted as one model's (paper, supplement). Models may differ in training, size
and backbone; they see one picture and choose from one vocabulary. The members are evaluated beside their ensemble; all
other keys are those of `python -m planners evaluate`, which takes `planner=a+b` for an ensemble as well.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from factory.config.shapes import GIVE, described
from factory.config.words import SettingsShown
from planners.command import command
from planners.evaluation.evaluate import evaluated, settings_of


@command
def main(argv: Sequence[str]) -> None:
    """The command: evaluates the members and their ensemble."""
    named = [argument.removeprefix("models=") for argument in argv if argument.startswith("models=")]
    members = [name.strip() for name in named[-1].strip("[]").split(",")] if named else []
    others = [argument for argument in argv if not argument.startswith("models=")]
    try:
        settings = settings_of(others)
    except SettingsShown as shown:
        raise SettingsShown("\n".join([*described({"models": members or GIVE}, None, {}), str(shown)])) from None
    if len(members) < 2:
        raise ValueError("models is missing: give models=[<training>,<training>,...], two at least")
    names = [Path(member).name for member in members]
    labels = names if len(set(names)) == len(names) else [str(i) for i in range(len(names))]
    evaluated(replace(settings, planners={**dict(zip(labels, members)), "ensemble": "+".join(members)}))
