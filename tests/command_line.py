"""The command line in this process."""

from typer.testing import CliRunner

from kcs_torch.cli import app


def run(*words, code=0):
    """Run a command, and return the whole result; what goes wrong otherwise than by an exit code is raised."""
    done = CliRunner().invoke(app, [str(word) for word in words])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == code, done.output
    return done
