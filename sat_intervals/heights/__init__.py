"""From disparity to ground: sensor models, points, surface models. The only home of shareloc."""
