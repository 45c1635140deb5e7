"""Hydra configuration: `task/NAME.yaml` and `method/NAME.yaml`, selected by `config.yaml`.

Nothing here defines a task: its constants live in Python. YAML holds the selection, the budgets
and the training settings.
"""
