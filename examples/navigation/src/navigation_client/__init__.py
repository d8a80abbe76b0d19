"""The client of the navigation example: sends a robot to one place after the other, as any user of Nav2 would."""
