"""The registry of brain configurations; `type` in a configuration file names one."""

import draccus


class BrainConfig(draccus.ChoiceRegistry):
    """Base class of brain configurations."""
