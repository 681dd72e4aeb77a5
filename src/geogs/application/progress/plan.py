"""What a forecast asks of the work whose end it tells."""

from geogs.application.progress.posed_plan import PosedPlan
from geogs.application.progress.run_plan import RunPlan

Plan = RunPlan | PosedPlan
