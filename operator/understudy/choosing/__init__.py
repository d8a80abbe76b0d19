"""In which order strategies are tried where a policy asks for an outcome and not for them: the paper's trade-off as a function.

Pure: from requirements and figures to an order, with the reason for each place in it.
"""
