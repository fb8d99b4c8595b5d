"""``python -m kcs_torch``: the command line, wherever its script is."""

from kcs_torch.cli import main

if __name__ == "__main__":
    main()
