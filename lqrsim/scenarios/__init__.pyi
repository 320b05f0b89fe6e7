from .packaged import Scenario as Scenario
from .packaged import differential_drive as differential_drive
from .packaged import get as get
from .packaged import names as names
from .packaged import quadrotor as quadrotor
from .packaged import quadrotor_queries as quadrotor_queries
from .references import mjcf as mjcf
