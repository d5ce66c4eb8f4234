"""Experts with settings of their own: the smooth planner, and the one that samples a vocabulary."""

from dataclasses import fields
from typing import Any

from factory.config.compose import ConfigError, fill
from factory.config.run import VocabularySources
from factory.setup.settings import RunContext, choose_vocabulary
from factory.setup.vocabulary import load_vocabulary
from tasks.experts.pdm_smooth.planner import PdmSmooth
from tasks.experts.pdm_smooth.settings import SmoothSettings
from tasks.experts.vocabulary.expert import VocabularyExpert
from tasks.experts.vocabulary.settings import VocabularySettings
from tasks.settings import ExpertGate


def pdm_smooth(run: RunContext, **settings: Any) -> PdmSmooth:
    """Of conf/expert/pdm_smooth.yaml. Raises ConfigError."""
    return PdmSmooth(fill(SmoothSettings, settings, f"expert.{run.name}"), run.name)


def vocabulary(run: RunContext, **settings: Any) -> VocabularyExpert:
    """Of conf/expert/vocabulary.yaml: it judges by the attempts' own traffic and gate. Raises ConfigError."""
    where, config = f"expert.{run.name}", run.config
    sources = fill(VocabularySources, settings, where)
    try:
        tried = choose_vocabulary(config.vocabulary) if sources.file is None else load_vocabulary(sources.file)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error
    return VocabularyExpert(
        tried,
        VocabularySettings(**{field.name: getattr(sources, field.name) for field in fields(VocabularySettings)}),
        config.traffic,
        ExpertGate(**{field.name: getattr(config.reward, field.name) for field in fields(ExpertGate)}),
        config.pdm,
        run.name,
    )
