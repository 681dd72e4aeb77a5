"""A result that was written can be used again as if it had just been made."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import geogs
from geogs.application.result import Result
from geogs.application.results import write_results
from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.reconstruction import Reconstruction
from posed_scene import ball_and_wall
