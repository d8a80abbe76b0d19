"""The short YAML form of health trees and of procedures, which defines the meaning of every notation.

Other notations are converted into it.
"""
