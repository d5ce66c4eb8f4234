"""The world a clip holds: ego, agents, lanes, lights, cameras, as frozen dataclasses of arrays."""
