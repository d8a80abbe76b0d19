"""The short YAML form of health trees and of procedures, which defines what every notation means.

Other notations are turned into it.
"""
