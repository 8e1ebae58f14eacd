from cadam3d.api.asset import Asset as Asset
from cadam3d.api.asset import load as load
from cadam3d.api.result_tables import ResultTable as ResultTable
from cadam3d.api.result_tables import evaluate as evaluate
from cadam3d.api.result_tables import sweep as sweep
from cadam3d.api.stepping import Stepper as Stepper
from cadam3d.api.stepping import compose as compose
from cadam3d.api.training import Run as Run
from cadam3d.api.training import train as train
from cadam3d.callback.base import Callback as Callback
from cadam3d.core.errors import UserError as UserError

__version__: str
