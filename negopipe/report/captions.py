"""Titles and captions of the report's figures: name -> title and text, with `{values}` that `caption` fills in."""

CAPTIONS = {
    "comparison": (
        "Arrivals, driving time, suspensions and reward: {settings}",
        """Boxes: middle half of the episodes, with the median as a line. Thin lines: 10th to 90th percentile. Dot and
        number: mean. Driving times are of arrivals only and are to be read together with the share of arrivals. A
        collision ends an episode early, so few suspensions are a merit only of a planner that arrives.""",
    ),
    "outcomes": (
        "Outcomes",
        """Each bar: all episodes of a planner. Deadlock: at the time limit the vehicles are at rest nose to nose.
        Timeout: any other episode that reaches the time limit. Collision: the ego collides. Social collision: social
        vehicles collide with each other, which does not change the ego's reward.""",
    ),
    "success_by_style": (
        "Success rate by social style",
        """Rows: planners. Columns: styles of the social driver, which the ego does not observe. A planner that adapts
        to the social driver has a dark row.""",
    ),
    "arrivals": (
        "Arrivals over time",
        """Each line: share of all episodes of a planner in which the ego has arrived by a time. A line that rises
        early belongs to a fast planner; a line that ends low, to one that often does not arrive.""",
    ),
    "outcome_map": (
        "{setting}: outcomes by style and start distance",
        """Episodes of the adaptive planner. Rows: styles of the social driver (0 s pushes, 6 s gives way). Columns:
        start distances, filled with the outcomes of their episodes. The bars below the columns mark distances that
        training left out: failures above them show a policy overfitted to the training distances.""",
    ),
    "space_time": (
        "{setting}: one task, every planner",
        """Position along the road over time, of the ego (upwards) and of the social vehicle (downwards); a flat line is
        a vehicle at rest. Shaded band: corridor. Colour of the ego's line: prediction horizon of the decision. Cross:
        collision. The task is that of the side-by-side animation.""",
    ),
    "film": (
        "{setting}, episode {episode}: {planners}",
        """The ego comes from the left in its planner's colour, the social vehicle ({style}) from the right
        in grey. Ribbon: the ego's prediction of the social vehicle.""",
    ),
    "film_alone": (
        "{setting}, episode {episode}: {planners}, {which}",
        """The ego comes from the left, the social vehicle ({style}) from the right in grey. Ribbon: the
        ego's prediction of the social vehicle. Below the road: the occupancy grids, where the policy observes them
        (ahead is to the right), and its probability of each prediction horizon.""",
    ),
    "cases": (
        "Every case: {measure}",
        """Rows: cases, each of which lies outside every training in a respect that its file in conf/unseen states.
        Columns: planners. All planners of a row drive the same tasks.""",
    ),
    "failure": (
        "{case}, task {task}: {planners}",
        """{outcome}: {cause}. The policy failed in {n_failed} of the {n_kept} tasks whose drives are kept:
        {causes}.""",
    ),
    "behaviour_index": (
        "Behaviour index",
        """Eq. 7. Above zero (prosocial) the social vehicle has travelled further since the start than the ego; below
        zero (competitive) the ego has. Thick line and band: median and 10th to 90th percentile of the adaptive
        planner. Thin lines: medians of the other planners. A line ends where fewer than a quarter of the planner's
        episodes still run.""",
    ),
    "behaviour_map": (
        "Behaviour map",
        """Every fixed horizon of the ego against every style of the social driver, on the same starts. Left: outcomes.
        Right: share of first passages that are the ego's, and mean smallest gap. {verdict}""",
    ),
    "horizons": (
        "Chosen horizons over time",
        """Share of all episodes in which the adaptive planner uses each prediction horizon at a time: 0 s ignores the
        social vehicle and pushes, 6 s gives way early. White: the episode is over.""",
    ),
    "horizons_along": (
        "Chosen horizons along the road",
        """Share of each prediction horizon among the decisions that the adaptive planner takes within each metre of the
        road. Dashed lines: mouths of the corridor. A waiting vehicle takes many decisions at one place.""",
    ),
    "streets_training": (
        "Streets of the training",
        """The first streets that the policy was trained on. The ego drives from the left to the right. Sizes are drawn
        from the intervals of scenario.road.""",
    ),
    "streets_held_out": (
        "Streets of the evaluation",
        """The first streets on which every planner was evaluated. Training has seen none of them.""",
    ),
    "learning_curves": (
        "Learning curves",
        """Success rate and return of the latest training episodes, over decisions and over wall time. Lines: means
        over seeds. Bands: lowest to highest seed.""",
    ),
    "training": (
        "Learning curves",
        """Thin lines: logged values. Thick lines: running means. Stages of the curriculum: {stages}. A dashed line
        begins the next stage, whose tasks are harder or other, so a drop there is expected.""",
    ),
    "training_outcomes": (
        "Outcomes during training",
        """Episodes of successive tenths of the training, by the social driver's style and start distance. Training
        samples its actions, so a few collisions are expected. Timeouts include deadlocks. The bars below the columns
        mark distances that training leaves out.""",
    ),
}

WATCH = (
    "Animations in real time. The successes of the adaptive planner in a setting are ranked by return (all episodes "
    "if there is no success). The median one is shown side by side with other planners on the same task; that of the "
    "first setting opens the page. Evenly spaced ranks and the episode of the lowest return are shown alone. Any other "
    "episode is animated by stages=[replay] episode=<setting>/<planner>/<number>."
)
FAILED = (
    "Of every case with a failure: a task that the policy failed by the most frequent cause of the case, beside the "
    "same task under the rule-based planner, if it was driven. unseen_failures.csv counts the causes of every planner."
)
NOT_TRAINED = "The policy was not trained in this run, so there is no history.csv. The config names its checkpoint."


def caption(name: str, **values: object) -> tuple[str, str]:
    """Title and text, filled in, each on one line."""
    title, text = CAPTIONS[name]
    return title.format(**values), " ".join(text.split()).format(**values)
