"""How the robot drove by its commands: how long they hold, how it turns, whether it steers."""
