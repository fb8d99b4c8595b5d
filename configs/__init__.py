"""Configurations of the scripts; shipped as kcs_torch.configs. Hydra finds them only in a package."""
