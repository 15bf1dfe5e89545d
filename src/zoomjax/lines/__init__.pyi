# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .base import AbstractLines as AbstractLines
from .compressed import CompressedLines as CompressedLines
from .compressed import compress as compress
from .compressed import merge as merge
from .csv import read_focal_csv as read_focal_csv
from .csv import read_lines_csv as read_lines_csv
from .csv import write_lines_csv as write_lines_csv
from .free_centre import AnyCentreLines as AnyCentreLines
from .free_centre import compress_any_centre as compress_any_centre
from .lines import Lines as Lines
from .npz import load_lines as load_lines
from .sharding import shard as shard
from .streaming import stream as stream
