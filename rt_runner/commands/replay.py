"""``rt-runner replay``: a log's frames through the C estimator once more; does every estimate come out again?"""

EXIT = {"identical": 0, "different": 2, "inconclusive": 3}


def add_parser(verbs) -> None:
    """Add the verb."""
    p = verbs.add_parser(
        "replay",
        help="a log's frames through the estimator again: the same estimates, bit for bit?",
        description="Feed a log's frames, with their stamps, to the C estimator and compare every estimate with the "
        "logged one, byte for byte; name the first that is not the same. Exit status 0 identical, 2 different, "
        "3 inconclusive (the log has gaps), 1 nothing to replay.",
    )
    p.add_argument("log", metavar="LOG", help="an .mcap file, or what python-can reads: candump's .log, .asc, .blf")
    p.add_argument("--json", metavar="FILE", help="write the outcome as JSON (- for standard output)")
    p.add_argument("--setting", metavar="NAME", help="setting of the estimator (default: what the log says)")
    p.add_argument("--period", type=float, metavar="S", help="period of its loop (default: what the log says)")
    p.set_defaults(run=run)


def run(args) -> int:
    """Replay; returns the exit status."""
    import sys

    from rt_runner import paths
    from rt_runner.any_log import raw_frames
    from rt_runner.config import check_period
    from rt_runner.dbc import load_dbc
    from rt_runner.errors import RtError, UsageError
    from rt_runner.present import check_json_path, write_json
    from rt_runner.replay.search import as_json, replay_frames
    from rt_runner.replay.show import lines

    check_json_path(args.json, args.log)
    if args.period is not None:
        check_period(args.period, "--period")
    if args.setting is not None and args.setting not in paths.setting_names():
        raise UsageError(
            f"--setting: no setting is called {args.setting!r}; there are {', '.join(paths.setting_names())}"
        )
    try:
        outcome = replay_frames(list(raw_frames(args.log)), load_dbc(), args.setting, args.period)
    except RtError as e:
        raise e if str(args.log) in str(e) else type(e)(f"{args.log}: {e}") from None
    figures = as_json(str(args.log), *outcome)
    write_json(figures, args.json)
    print("\n".join(lines(figures, outcome[1].difference)), file=sys.stderr if args.json == "-" else sys.stdout)
    return EXIT[figures["verdict"]]
