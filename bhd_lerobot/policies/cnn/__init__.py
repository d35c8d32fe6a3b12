"""`bhd_cnn`, a small policy that drives a base by what its camera shows and has shown."""

__all__ = ["configuration_cnn", "modeling_cnn", "processor_cnn"]
