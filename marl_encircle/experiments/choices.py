"""What users choose from by name, in Python and on the command line alike; imports nothing, so that help is quick."""

from typing import Literal

AlgorithmName = Literal["maddpg", "matd3"]
Engine = Literal["native", "supersuit"]
ExecutorName = Literal["local", "ray"]
ExportFormat = Literal["onnx", "torchscript", "torch-export"]
Profile = Literal["full", "smoke"]
