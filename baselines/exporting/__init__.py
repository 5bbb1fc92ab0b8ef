"""Export for autopilots: trained policies as ONNX or C99, and filters as libraries with C99 API."""

from baselines.exporting.controller import Controller, c_source, controller_of, save_onnx
from baselines.exporting.filter_library import TARGETS, export_filter

__all__ = ["TARGETS", "Controller", "c_source", "controller_of", "export_filter", "save_onnx"]
