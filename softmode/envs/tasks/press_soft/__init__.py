"""PressSoft: press on a soft pad and hold a contact force."""
