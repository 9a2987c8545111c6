"""How to read each figure of the report: name -> title and text, with `{values}` that `caption` fills in."""

CAPTIONS = {
    "comparison": (
        "Arrivals, time, suspensions and reward: {settings}",
        """Boxes hold the middle half of the episodes, the line in them is the median; thin lines reach
        from the 10th to the 90th percentile; the dot and the number are the mean. Driving times are
        of arrivals only: read them together with the share that arrived. A crash ends an episode
        early, so few suspensions and little time at rest speak only for a planner that arrives.""",
    ),
    "outcomes": (
        "How the episodes ended",
        """Each bar is all episodes of a planner. Deadlock: both vehicles stand, facing each other;
        timeout: any other episode that was not finished within the limit. A collision is one of the ego; one
        among the other vehicles only is a social collision, which costs the ego nothing.""",
    ),
    "success_by_style": (
        "Success against every style",
        """Rows are planners, columns are styles of the other driver, which the ego is not told. A
        planner that reads the other driver is dark in the whole row.""",
    ),
    "arrivals": (
        "Arrivals over time",
        """Each line is a planner: the share of all its episodes in which the ego has arrived by a time. A
        line that rises early is fast, one that ends low often does not arrive at all.""",
    ),
    "outcome_map": (
        "{setting}: which tasks succeed",
        """Of the adaptive planner. Each row is a style of the other driver (0 s pushes, 6 s gives way),
        each column a start distance; a column is filled with the outcomes of its episodes. The bars
        below mark distances that training left out: where failures stand above them, the policy has
        learnt its tasks by heart.""",
    ),
    "space_time": (
        "{setting}: one task, every planner",
        """The ego drives upwards in the diagram, the social vehicle downwards; where a line is flat, the
        vehicle stands. The shaded band is the corridor. The ego's line has the colour of the
        prediction horizon that it used; a cross is a collision. The task is that of the animation
        side by side.""",
    ),
    "film": (
        "{setting}, episode {episode}: {planners}",
        """The ego comes from the left in its planner's colour, the social vehicle (own horizon
        {style_s:g} s) from the right in grey, with the ribbon that the ego's planner foresees of it.""",
    ),
    "film_alone": (
        "{setting}, episode {episode}: {planners}, {which}",
        """The ego comes from the left, the social vehicle (own horizon {style_s:g} s) from the right in grey, with
        the ribbon that the ego's planner foresees of it. Below the road stand the occupancy grids that the policy
        sees, ahead is to the right, and how likely it finds each prediction horizon.""",
    ),
    "behaviour_index": (
        "Behaviour index",
        """Eq. 7. Above zero the social vehicle has come further since the start than the ego
        (prosocial), below zero the ego has (competitive). Thick line and band: median and 10th to
        90th percentile of the adaptive planner; thin lines: medians of the others. A line ends where
        fewer than a quarter of the planner's episodes still run.""",
    ),
    "behaviour_map": (
        "When two horizons meet",
        """Every fixed horizon of the ego against every style of the social driver, on the same starts. On the left each
        cell is filled with the outcomes; on the right stands how often the ego passes first, of the episodes in which
        anybody does, and the mean smallest gap. {verdict}""",
    ),
    "horizons": (
        "Horizons that the policy chose",
        """At each time, the share of all episodes in which the adaptive planner used each prediction
        horizon: 0 s ignores the social vehicle and pushes, 6 s gives way early. White: the episode is
        over.""",
    ),
    "horizons_along": (
        "Where it chose them",
        """The same choices by place: of all decisions that the adaptive planner took within a metre of the road, the
        share of each horizon. Dashed lines are the mouths of the corridor. Where it waits it decides many times.""",
    ),
    "learning_curves": (
        "Learning curves",
        """Success rate and return of the latest episodes while training, over decisions and over wall time. Lines
        are means over seeds, bands reach from the lowest to the highest seed.""",
    ),
    "training": (
        "Learning curves",
        """Thin: as logged; thick: running mean. Stages of the curriculum: {stages}. A dashed line begins
        the next one, whose tasks are drawn differently, so a drop there is no setback.""",
    ),
    "training_outcomes": (
        "What was mastered when",
        """Episodes of the training, a tenth of it at a time, by the other driver's style and start distance. Actions
        are drawn here, so a few crashes are part of it. A timeout is any episode that was not finished within the
        limit, deadlocks among them. The bars below mark distances that training leaves out.""",
    ),
}

WATCH = (
    "Real time. The adaptive planner's successes in a setting are ranked by return (without a success, all "
    "episodes are). The median one is shown side by side with other planners on the same task. Evenly spaced "
    "ranks and the episode of the lowest return are shown alone. To watch any other episode: "
    "stages=[replay] episode=<setting>/<planner>/<number>."
)
NOT_TRAINED = "The policy was not trained in this run: there is no history.csv. The config names its checkpoint."


def caption(name: str, **values: object) -> tuple[str, str]:
    """Title and text, filled in, each on one line."""
    title, text = CAPTIONS[name]
    return title.format(**values), " ".join(text.split()).format(**values)
