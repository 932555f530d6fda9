"""The option ``--quick`` of benchmarks: less of what is measured, well under a minute."""


def parse_options(parser, **quick):
    """Parse the command line; with ``--quick``, `quick` stands in place of what was given."""
    changes = ", ".join(f"{name} {value}" for name, value in quick.items())
    parser.add_argument("--quick", action="store_true", help=f"only {changes}".replace("_", " "))
    options = parser.parse_args()
    if options.quick:
        vars(options).update(quick)
    return options
