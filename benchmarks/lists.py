"""Options that take several values: ``--max-error 0 1 3``."""

import click


class ListOption(click.Option):
    """An option that takes every value up to the next option."""

    def __init__(self, *args, **kwargs) -> None:
        """Make it a repeatable option."""
        super().__init__(*args, multiple=True, **kwargs)


class ListCommand(click.Command):
    """A command whose `ListOption` values need not repeat the option's name."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Write ``--x 1 2`` as ``--x 1 --x 2`` before click sees it.

        A list ends at the next option or at ``--``.
        """
        options = [param for param in self.params if isinstance(param, ListOption)]
        lists = {name for option in options for name in option.opts}
        return super().parse_args(ctx, repeat_option_names(args, lists))


def repeat_option_names(args: list[str], lists: set[str]) -> list[str]:
    """Return `args` with the name of each option in `lists` before each of its values."""
    repeated: list[str] = []
    name, n_values = "", 0
    for arg in [*args, "--"]:
        if arg.startswith("--") and name and not n_values:
            repeated.append(name)  # without a value: click says so
        if arg in lists:
            name, n_values = arg, 0
            continue
        if arg.startswith("--"):
            name = ""
        if name:
            repeated.append(name)
            n_values += 1
        if arg != "--":
            repeated.append(arg)
    return repeated
