import bhd_lerobot.plugin  # noqa: D100, F401 - LeRobot imports this module by the distribution's name
