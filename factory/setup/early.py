"""What a run names outside its settings, looked up before anything heavy is imported and any clip is read.

Classes of plug-ins, folders of logs, the cameras of their rigs. What only reading a clip can tell comes later.
"""

from factory.config.classes import class_of
from factory.config.datasets import data_set_of
from factory.config.plugins import offered
from factory.config.run import RunConfig, built_in_classes, refuse_missing_root
from factory.config.words import ConfigError
from tasks.render.settings import RenderMode


def refuse_what_is_not_there(config: RunConfig) -> None:
    """Raises ConfigError for the first name that stands for nothing, with the nearest that does."""
    refuse_missing_root(config.clips)
    refuse_missing_classes(config)
    refuse_cameras_of_no_rig(config)


def refuse_missing_classes(config: RunConfig) -> None:
    """Raises ConfigError where the class of the reader, or of an expert that the user configured, is not there."""
    named = {"clips": (config.clips, "my_package.MyReader")}
    others = {plugin.target for plugins in offered("expert").values() for plugin in plugins}
    for name, spec in config.expert.items():
        if name in config.experts or spec.get("_target_") not in others:  # an installed one may lie idle, and broken
            named[f"expert.{name}"] = (spec, "my_package.MyExpert")
    built_in = {*built_in_classes("clips").values(), *built_in_classes("expert").values()}
    for where, (spec, example) in named.items():
        if spec.get("_target_") not in built_in:
            class_of(spec, where, example)


def refuse_cameras_of_no_rig(config: RunConfig) -> None:
    """Raises ConfigError for a root without logs, and for a camera in render.cameras that the rig of no log has.

    Settings of rigs are held against themselves; the rig of a user's own reader is known when a clip is read.
    """
    clips, wanted = config.clips, config.render.cameras
    look = getattr(data_set_of(clips), "camera_names", None)
    if look is None:
        return
    try:
        rig: tuple[str, ...] = look(clips)
    except ValueError as error:
        raise ConfigError(f"clips: {error}") from error
    if not wanted or config.render.mode is RenderMode.NONE:
        return
    if not rig and config.render.mode is RenderMode.MAP:
        from tasks.render.views import MAP_RIG

        rig = tuple(camera.name for camera in MAP_RIG)
    if missing := [name for name in wanted if name not in rig]:
        none = f"no log under {clips['root']} has calibrated cameras"
        if "cameras" in clips:
            none += "; clips.cameras=<sidecar> brings some"
        has = f"this rig has {', '.join(rig)}" if rig else none
        raise ConfigError(f"render.cameras: no camera {', '.join(missing)}; {has}")
