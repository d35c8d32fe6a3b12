"""Eyes: from a camera's image to the objects on the table, with how sure that is."""

__all__ = [
    "assessment",
    "camera",
    "configuration_perception",
    "labels",
    "modeling_perception",
    "perceiver",
    "processor_perception",
    "refit",
]
