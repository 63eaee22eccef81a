from .corridor.process import (
    five_cells as five_cells,
)
from .gym.tabular import (
    TabularEnv as TabularEnv,
)
from .labyrinth.process import (
    Bout as Bout,
)
from .labyrinth.process import (
    Labyrinth as Labyrinth,
)
from .labyrinth.process import (
    demonstration_of as demonstration_of,
)
from .labyrinth.process import (
    mouse_labyrinth as mouse_labyrinth,
)
from .labyrinth.process import (
    read_bouts as read_bouts,
)
from .labyrinth.process import (
    simulate_bouts as simulate_bouts,
)
from .noisy.swap_noise import (
    SwapNoise as SwapNoise,
)
from .noisy.tasks import (
    NoisyTask as NoisyTask,
)
from .noisy.tasks import (
    demonstrate_noisy as demonstrate_noisy,
)
from .noisy.tasks import (
    noisy_patrol as noisy_patrol,
)
from .noisy.tasks import (
    noisy_sorting as noisy_sorting,
)
from .object_world.process import (
    ObjectWorld as ObjectWorld,
)
from .object_world.process import (
    random_object_world as random_object_world,
)
from .patrol.environment import (
    BreachEnv as BreachEnv,
)
from .patrol.process import (
    Patrol as Patrol,
)
from .patrol.process import (
    boyd_fifth_floor as boyd_fifth_floor,
)
from .patrol.process import (
    boyd_with_rooms as boyd_with_rooms,
)
from .patrol.process import (
    demonstrate as demonstrate,
)
from .patrol.process import (
    four_hallways as four_hallways,
)
from .patrol.process import (
    instance as instance,
)
from .patrol.process import (
    simulate_patrol as simulate_patrol,
)
from .patrol.trials import (
    Planning as Planning,
)
from .patrol.trials import (
    Watching as Watching,
)
from .patrol.trials import (
    breach_trials as breach_trials,
)
from .robots.control import (
    cart_pole as cart_pole,
)
from .robots.control import (
    mountain_car as mountain_car,
)
from .robots.experts import (
    load_demonstrations as load_demonstrations,
)
from .robots.experts import (
    load_expert as load_expert,
)
from .robots.onion_recordings import (
    read_onion_recordings as read_onion_recordings,
)
from .robots.onion_recordings import (
    write_onion_recordings as write_onion_recordings,
)
from .robots.reaching import (
    onion_reaching as onion_reaching,
)
from .robots.walkers import (
    locomotion as locomotion,
)
from .sorting.line import (
    sort_belts as sort_belts,
)
from .sorting.process import (
    Sorting as Sorting,
)
from .sorting.process import (
    demonstrate_sorting as demonstrate_sorting,
)
from .sorting.process import (
    pick_inspect_place as pick_inspect_place,
)
from .sorting.process import (
    sorting_with_claiming as sorting_with_claiming,
)
from .sorting.process import (
    sorting_without_claiming as sorting_without_claiming,
)
