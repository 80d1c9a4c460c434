"""The log of --writecsv."""

from crazyarena.crazyswarm_compat.csv_log import CsvLog as Output

__all__ = ["Output"]
