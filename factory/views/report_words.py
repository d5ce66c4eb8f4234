"""What reasons, gates and ends of a run are called on the pages, and the published rates beside ours."""

from tasks.subscores import RECORDS

# SimScale: clips with a sample of the round, in % of those with one of the round before.
PAPER_CLIP_PERCENT = {"pdm_closed": (63, 85, 83, 83, 84), "recovery": (43, 80, 78, 78, 78)}
STATUS = {  # exit code -> words, tone
    0: ("complete", "good"),
    3: ("complete, with failed attempts", "warn"),
    4: ("interrupted: the same command goes on", "warn"),
}

REASON_WORDS = {
    **{record.name: record.wrong for record in RECORDS},
    "off_route": "the route does not go on where the drive ends",
    "after": "somebody is hit in the second after the drive",
    "no_plan": "the expert found no plan",
    "route_ended": "no route is left to drive along",
    "psnr": "block reconstructed too poorly",
    "holes": "rendered where nothing was seen",
    "lens_covered": "something covers the lens",
    "blank": "nothing to be seen on a picture",
    "blurred": "a picture without detail",
    "unlike_photos": "a vehicle nearby looks like none of its photos",
    "ego_standing": "ego stands",
    "no_earlier_frame": "the log begins too late for a frame before it",
    "broken_tracks": "broken tracks",
    "no_gated_candidate": "no trajectory passes the gates",
    "no_good_candidate": "no trajectory scores well enough",
    "input": "input is broken",
    "bug": "the code raised",
    "machine": "the machine was ill",
    "system": "a worker died, or a file could not be read",
    "limit": "ended over its limits of time or memory",
    "poison": "workers died at it again and again",
}
GATE_WORDS = {
    "raw_longitudinal": "raw end pose too far along",
    "raw_lateral": "raw end pose too far aside",
    "raw_heading": "raw end pose turned too far",
    "reached_longitudinal": "reached end pose too far along",
    "reached_lateral": "reached end pose too far aside",
    "reached_heading": "reached end pose turned too far",
    "white_cell": "in a cell the grid leaves out",
    "replay_score": "scored too low against log replay",
    "reactive_score": "scored too low among reacting agents",
}


def to_the_side(y_m: float) -> str:
    """A distance across, by the word for its side: y of the ego frame points left."""
    return f"{abs(y_m):.2f} m to the {'left' if y_m >= 0.0 else 'right'}"


def turned(heading_rad: float) -> str:
    """A turn by the word for its side: counter-clockwise is left."""
    return f"{abs(heading_rad) * 57.29578:.1f} deg to the {'left' if heading_rad >= 0.0 else 'right'}"
