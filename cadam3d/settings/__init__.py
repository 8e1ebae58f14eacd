"""Settings: the only code that knows Hydra and OmegaConf."""
