"""Logs that 123D (py123d) converted, read from its files alone.

`<data root>/logs/<split>/<log>/` holds one Arrow IPC file a modality, `<data root>/maps/<data set>/` the maps that logs
share. Format: kesai-labs/py123d, src/py123d/api, versions 0.6 and 0.7 (the same in all that is read here).
"""
