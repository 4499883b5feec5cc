"""Old name of `quadid_evaluation.paper`, for one release."""

from quadid.old_paths import stand_in

stand_in(__name__)
