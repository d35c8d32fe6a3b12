"""The registry of task configurations; `type` in a configuration file names one."""

import draccus


class TaskConfig(draccus.ChoiceRegistry):
    """Base class of task configurations."""
