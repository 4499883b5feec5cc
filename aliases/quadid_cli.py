"""Old name of `quadid.cli`, for one release."""

from quadid.old_paths import stand_in

stand_in(__name__)
