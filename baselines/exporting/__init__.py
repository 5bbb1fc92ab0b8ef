"""Export for autopilots: trained policies as ONNX or C99, and filters as libraries with C99 API."""

from baselines.exporting.controller import Controller, controller_of
from baselines.exporting.filter_library import TARGETS, export_filter
from baselines.exporting.onnx_model import save_onnx
from baselines.exporting.source import c_source

__all__ = ["TARGETS", "Controller", "c_source", "controller_of", "export_filter", "save_onnx"]
