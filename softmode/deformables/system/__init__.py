"""The linear system of a Newton step: assembled, factored, solved. It knows no contact and no time."""
