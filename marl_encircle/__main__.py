"""The ``marl-encircle`` command and ``python -m marl_encircle``."""


def main() -> None:
    """Run the command; Ctrl-C ends it with 130 and no traceback, also during the seconds that imports take."""
    try:
        from marl_encircle import cli

        cli.main()
    except KeyboardInterrupt:
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
