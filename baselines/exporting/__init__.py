"""Export for autopilots: trained policies as ONNX or C99, and the parameters of a filter."""

from baselines.exporting.controller import Controller, controller_of
from baselines.exporting.filter_numbers import filter_header, filter_numbers
from baselines.exporting.onnx_model import save_onnx
from baselines.exporting.source import c_source

__all__ = [
    "Controller",
    "c_source",
    "controller_of",
    "filter_header",
    "filter_numbers",
    "save_onnx",
]
