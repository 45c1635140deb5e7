"""Hydra configuration: `task/NAME.yaml` and `method/NAME.yaml`, selected by `config.yaml`.

YAML does not define a task: its constants are in Python. It holds the selection, the budgets and
the training settings.
"""
